"""The experiment of a recipe as a table."""

from collections.abc import Mapping
from typing import Any, Final

from cprl.checks import check_nesting, checked, instance, shown
from cprl.runs import formats

FORMAT: Final = formats.RECIPE
"""Of `recipe.json`."""


def recipe_config(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """The experiment of a recipe, as `Experiment.to_config` gives it.

    Raises:
        ValueError: for another format.
    """
    checked("the recipe", recipe, instance(Mapping, "a table"))
    check_nesting(recipe, "the recipe")
    formats.refuse_newer("the recipe", recipe, FORMAT)
    if recipe.get("format") != FORMAT or not isinstance(recipe.get("experiment"), Mapping):
        raise ValueError(
            f"the recipe has the format {shown(recipe.get('format'))}; allowed: {FORMAT}, with a table "
            '"experiment"'
        )
    return dict(recipe["experiment"])
