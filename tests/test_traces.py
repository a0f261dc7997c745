"""As the study was run, the game equals the published program, action by action."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cprl import presets
from cprl.commons.batch import Batch

TRACES = sorted((Path(__file__).parent / "traces").glob("*.npz"))
REGROW_PROB = {"none": (0.0,), "all": (0.0, 1.0)}


EARLIER, NO_BEAM = "two_complex_10_april", "two_complex_no_beam"
"""Of cba933a and, without a beam, of 65e3bf7: agent 1's action "right" moves agent 0."""


def traced_game(name: str):
    board, _, regrowth = name.rpartition("_")
    if board in (EARLIER, NO_BEAM):
        game = presets.game("two_complex", variant="as_run_10_april")
    else:
        game = presets.game(board, variant="as_run")
    changed = {"regrow_prob": REGROW_PROB[regrowth], "episode_steps": 10_000}
    changed |= {"may_fire": False} if board == NO_BEAM else {}
    return replace(game, rules=replace(game.rules, **changed))


@pytest.mark.parametrize("path", TRACES, ids=lambda path: path.stem)
def test_windows_rewards_tags_and_ends_equal_the_published_program(path):
    trace, game = np.load(path), traced_game(path.stem)
    batch = Batch(game, 1)
    output = batch.begin(batch.new_output())
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


def test_all_twelve_traces_are_there():
    boards = (*presets.BOARDS, EARLIER, NO_BEAM)
    names = {f"{board}_{regrowth}" for board in boards for regrowth in REGROW_PROB}
    assert {path.stem for path in TRACES} == names


def test_one_trace_ends_by_depletion():
    assert [path.stem for path in TRACES if np.load(path)["done"].any()] == ["commons_none"]


@pytest.mark.parametrize("board", [EARLIER, NO_BEAM])
@pytest.mark.parametrize("regrowth", REGROW_PROB)
def test_the_programs_with_the_fault_play_another_game_without_it(board, regrowth):
    path = Path(__file__).parent / "traces" / f"{board}_{regrowth}.npz"
    trace, game = np.load(path), traced_game(path.stem)
    batch = Batch(replace(game, rules=replace(game.rules, agent_1_right_moves_agent_0=False)), 1)
    output = batch.begin(batch.new_output())
    shown = trace["obs"].reshape(-1, game.agents, *game.observation_shape)
    first = int(np.flatnonzero(trace["actions"][:, 1] == 3)[0])
    for turn, actions in enumerate(trace["actions"][: first + 1]):
        batch.play(actions.astype(np.int64).reshape(1, -1), output)
        assert np.array_equal(output.observation[0], shown[turn + 1]) == (turn < first)


def test_the_traces_of_the_earlier_program_hold_what_the_fault_does_at_edges_in_clashes_and_out_of_play():
    seen = Counter()
    for regrowth in REGROW_PROB:
        path = Path(__file__).parent / "traces" / f"{EARLIER}_{regrowth}.npz"
        trace, batch = np.load(path), Batch(traced_game(path.stem), 1)
        output, now = batch.begin(batch.new_output()), batch.now
        for actions in trace["actions"].astype(np.int64):
            in_play, before = output.in_play[0].copy(), (now.row[0, 0], now.col[0, 0])
            batch.play(actions.reshape(1, -1), output)
            if actions[1] == 3 and in_play[1]:
                moved = before != (now.row[0, 0], now.col[0, 0])
                seen["in play" if in_play[0] else "out of play"] += 1
                seen["out of play, moved"] += moved and not in_play[0]
                seen["fired and moved"] += bool(now.moved_after_firing[0, 0])
                seen["stopped"] += actions[0] >= 4 and not moved
    assert min(seen.values()) >= 20, seen
