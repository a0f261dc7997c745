"""The experiment of a recipe as a table, of today's format or of any before."""

import os
from collections.abc import Mapping
from typing import Any, Final

from cprl.checks import check_nesting, checked, instance, shown
from cprl.runs import formats
from cprl.runs.old_recipes import experiment_config, has_old_rules, upgraded_game

FORMAT: Final = formats.RECIPE
"""Of `recipe.json`; those of before, which had "arguments", are read too."""


def recipe_config(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """The experiment of a recipe, of today's format or of any before, as `Experiment.to_config` gives it.

    Raises:
        ValueError: for another format, and for one of before that lacks what each had.
    """
    checked("the recipe", recipe, instance(Mapping, "a table"))
    check_nesting(recipe, "the recipe")
    if not is_old(recipe):
        formats.refuse_newer("the recipe", recipe, FORMAT)
        if recipe.get("format") != FORMAT or not isinstance(recipe.get("experiment"), Mapping):
            raise ValueError(
                f"the recipe has the format {shown(recipe.get('format'))}; allowed: {FORMAT}, with a table "
                '"experiment"'
            )
        experiment = dict(recipe["experiment"])
        if has_old_rules(experiment.get("game")):
            experiment["game"] = upgraded_game(experiment["game"])
        return experiment
    try:
        table = experiment_config(recipe)
        for agent in table["agents"]:
            if agent["kind"] == "Frozen":  # absolute at that time
                agent["run"] = os.path.relpath(agent["run"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"the recipe holds no game and agents of cprl: {error!r}") from error
    return table


def is_old(recipe: Mapping[str, Any]) -> bool:
    """Whether a recipe is of the time before formats had numbers."""
    return "arguments" in recipe and "format" not in recipe
