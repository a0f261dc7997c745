"""As the study was run, the game equals the published program, action by action."""

from dataclasses import replace

import numpy as np
import pytest
from places import DATA

from cprl import presets
from cprl.commons.batch import Batch

TRACES = sorted((DATA / "traces").glob("*.npz"))
REGROW_PROB = {"none": (0.0,), "all": (0.0, 1.0)}


def traced_game(name: str):
    board, _, regrowth = name.rpartition("_")
    game = presets.game(board, variant="as_run")
    return replace(game, rules=replace(game.rules, regrow_prob=REGROW_PROB[regrowth], episode_steps=10_000))


@pytest.mark.parametrize("path", TRACES, ids=lambda path: path.stem)
def test_windows_rewards_tags_and_ends_equal_the_published_program(path):
    trace, game = np.load(path), traced_game(path.stem)
    batch = Batch(game, 1)
    output = batch.begin()
    windows = trace["obs"].reshape(-1, game.agents, *game.observation_shape)
    assert np.array_equal(output.observation[0], windows[0]), "the first windows differ"
    for turn, actions in enumerate(trace["actions"]):
        in_play = output.in_play[0].sum()
        batch.play(actions.astype(np.int64).reshape(1, -1), output)
        assert np.array_equal(output.observation[0], windows[turn + 1]), f"windows differ after turn {turn}"
        assert np.array_equal(output.harvest[0], trace["reward"][turn]), f"rewards differ in turn {turn}"
        assert output.terminated[0, 0] == trace["done"][turn], f"the end differs in turn {turn}"
        if trace["untagged"][turn] >= 0:
            assert in_play == trace["untagged"][turn], f"agents in play differ in turn {turn}"


def test_all_eight_traces_are_there_and_one_ends_by_depletion():
    names = {f"{board}_{regrowth}" for board in presets.BOARDS for regrowth in REGROW_PROB}
    assert {path.stem for path in TRACES} == names
    assert [path.stem for path in TRACES if np.load(path)["done"].any()] == ["commons_none"]
