"""Institutions play what the rules of November 2026 that they replaced did.

`traces/old_rules.json` holds games, and what the program of that time played.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from cprl.commons.batch import Batch, turn_of
from cprl.config import from_config
from cprl.institutions import Boundaries, GraduatedSanctions, Sanctioner

CASES = json.loads((Path(__file__).parent / "traces" / "old_rules.json").read_text())
OUTPUTS = ("observation", "harvest", "in_play", "fired", "hit_by", "tagged_by", "stock", "regrown", "done")
STATES = ("row", "col", "heading", "out_steps", "offences", "tagged_step")


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


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_institutions_play_as_the_rules_before_them_did_bit_for_bit(case):
    game = from_config(case["game"])
    assert played(game) == case["played"]
    assert game.channels == ("red", "green", "blue"), "agents see what they saw"


def test_each_old_rule_becomes_the_institution_that_says_the_same():
    of_case = {case["name"]: from_config(case["game"]).institutions for case in CASES}
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
