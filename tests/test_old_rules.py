"""Recipes with the rules of before December 2026, which are institutions now, play exactly as they did.

`traces/old_rules.json` holds games as `recipe.json` held them, and what the program of that time played.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from cprl.commons.batch import Batch, turn_of
from cprl.config import from_config
from cprl.institutions import Boundaries, GraduatedSanctions, Sanctioner
from cprl.runs.old_recipes import upgraded_game
from cprl.runs.recipes import FORMAT, recipe_config

CASES = json.loads((Path(__file__).parent / "traces" / "old_rules.json").read_text())
OUTPUTS = ("observation", "harvest", "in_play", "fired", "hit_by", "tagged_by", "stock", "regrown", "done")
STATES = ("row", "col", "heading", "out_steps", "offences", "tagged_step")


def in_experiment(game):
    """A recipe as `Experiment` writes it."""
    return {"format": FORMAT, "experiment": {"name": "old", "game": game}}


def in_arguments(game):
    """A recipe of the time before `Experiment`."""
    bare = {
        part: {name: own for name, own in game[part].items() if name != "kind"}
        for part in ("map", "rules", "observation")
    }
    random = [{"member": "Scripted", "manner": "random"}] * len(game["map"]["starts"])
    return {"recipe": "old", "arguments": {"game": bare, "episodes": 1, "population": random}}


def played(game, *, turns=150, worlds=4):
    """The same turns as those of the trace, as a digest and in numbers."""
    batch = Batch(game, worlds, seed=8)
    output = batch.begin(batch.new_output())
    actions = np.random.default_rng(0).integers(0, len(game.actions), (turns, worlds, game.agents))
    digest, harvest, tags, shots = hashlib.sha256(), 0, 0, 0
    for number, turn in enumerate(actions):
        own = turn_of(batch.play(turn, output))
        for record, names in ((own, OUTPUTS), (batch.now, STATES)):
            for name in names:
                digest.update(getattr(record, name).tobytes())
        harvest += int(own.harvest.sum())
        tags += int(own.tagged_by.any(2).sum())
        shots += int(own.fired.sum())
        if number % 40 == 39:
            batch.begin(output, own.done[:, 0].copy())
    return {"sha256": digest.hexdigest(), "harvest": harvest, "tags": tags, "shots": shots}


@pytest.mark.parametrize("recipe", [in_experiment, in_arguments])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_an_old_recipe_plays_as_it_did_bit_for_bit(case, recipe):
    game = from_config(recipe_config(recipe(case["game"]))["game"])
    assert played(game) == case["played"]
    assert game.channels == ("red", "green", "blue"), "agents see what they saw"


def test_each_old_rule_becomes_the_institution_that_says_the_same():
    of_case = {
        case["name"]: from_config(recipe_config(in_experiment(case["game"]))["game"]).institutions
        for case in CASES
    }
    kinds = {name: [type(own) for own in found] for name, found in of_case.items()}
    assert kinds == {
        "bites": [Boundaries],
        "bites, some sites of nobody": [Boundaries],
        "fire": [Sanctioner],
        "freeze": [GraduatedSanctions],
        "freeze of one offence": [GraduatedSanctions],
        "all": [Boundaries, Sanctioner, GraduatedSanctions],
        "all as run": [Boundaries, Sanctioner, GraduatedSanctions],
        "nobody fires": [],
        "everybody fires": [GraduatedSanctions],
    }
    assert of_case["fire"] == (Sanctioner(agents=(0, 2), observed=False),)
    assert "-" in "".join(of_case["bites, some sites of nobody"][0].regions)


def test_a_table_with_another_column_for_every_site_is_read():
    # 7 agents and 60 sites: 60 different columns, more than there are digits and letters.
    sites = [[row, col] for row in range(6) for col in range(10)]
    may_bite = [[bool((n + 1) >> agent & 1) for n in range(60)] for agent in range(7)]
    board = {"height": 7, "width": 10, "sites": sites, "starts": [[6, n, 0] for n in range(7)], "walls": []}
    game = upgraded_game({"map": board, "rules": {"may_bite": may_bite}})
    (table,) = game["institutions"]
    own = Boundaries(**{name: value for name, value in table.items() if name != "kind"})
    own.check_board(agents=7, height=7, width=10)
    for agent, row in enumerate(may_bite):
        for (r, c), may in zip(sites, row, strict=True):
            assert (own.regions[r][c] in own.signs_of(agent)) == may


def test_recipes_of_today_are_left_as_they_are():
    game = dict(CASES[0]["game"])
    rules = {name: own for name, own in game["rules"].items() if name != "may_bite"}
    now = {**game, "rules": {**rules, "may_fire": True, "freeze_steps": 4}, "institutions": []}
    assert recipe_config(in_experiment(now))["game"] == now
