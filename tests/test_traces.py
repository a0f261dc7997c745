"""As the study was run, the game equals the published program, action by action; and the fault of the program
of 10 April 2019, `agent_1_right_moves_agent_0`: worked cases, presets and states."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from boards import SIGN_OF_NAME, Play

from cprl import Game, Rules, maps, presets
from cprl.commons.batch import Batch
from cprl.commons.colours import CLASS_NAMES
from cprl.commons.state import NAMES
from cprl.institutions import Sanctioner

FOLDER = Path(__file__).parent / "traces"
TRACES = sorted(FOLDER.glob("*.npz"))
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


def test_all_twelve_traces_are_there_and_one_ends_by_depletion():
    boards = (*presets.BOARDS, EARLIER, NO_BEAM)
    names = {f"{board}_{regrowth}" for board in boards for regrowth in REGROW_PROB}
    assert {path.stem for path in TRACES} == names
    assert [path.stem for path in TRACES if np.load(path)["done"].any()] == ["commons_none"]


@pytest.mark.parametrize("board", [EARLIER, NO_BEAM])
@pytest.mark.parametrize("regrowth", REGROW_PROB)
def test_the_programs_with_the_fault_play_another_game_without_it(board, regrowth):
    name = f"{board}_{regrowth}"
    trace, game = np.load(FOLDER / f"{name}.npz"), traced_game(name)
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
        name = f"{EARLIER}_{regrowth}"
        trace, batch = np.load(FOLDER / f"{name}.npz"), Batch(traced_game(name), 1)
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


VARIANT = "as_run_10_april"


def play(board, **rules):
    return Play(board, agent_1_right_moves_agent_0=True, **rules)


def picture(play):
    """The whole board as it is painted."""
    rows = play.batch.boards(play.output)[0]
    return "\n".join("".join(SIGN_OF_NAME[CLASS_NAMES[kind]] for kind in row) for row in rows)


def test_right_of_agent_1_moves_agent_0_to_the_right_of_its_own_heading_after_its_own_action():
    played = play("A....\n>....\n....^\n.....")
    assert played.turn("stay", "right").places == [(2, 0), (2, 4)], "0 faces right: down; 1 stays"
    assert played.turn("forward", "right").places == [(3, 1), (2, 4)], "its own step, then the other"
    assert played.turn("left", "right").places == [(3, 1), (2, 4)], "up, then down"
    assert played.turn("stay", "right").places == [(3, 1), (2, 4)], "the edge stops it"
    assert played.turn("turn_left", "right").places == [(3, 2), (2, 4)], "it has turned up before"
    assert played.turn("stay", "left").places == [(3, 2), (2, 3)], "other actions of 1 move 1"
    assert played.turn("right", "stay").places == [(3, 3), (2, 3)], "right of 0 moves 0"


def test_right_of_agent_2_moves_agent_2():
    assert play("A....\n^^^..").turn("stay", "stay", "right").places == [(1, 0), (1, 1), (1, 3)]


@pytest.mark.parametrize("pairwise", [False, True])
def test_agent_0_goes_back_if_it_ends_on_agent_1_and_may_pass_over_it(pairwise):
    played = play("A...\n>...\n.>..", pairwise_clashes=pairwise)
    assert played.turn("forward", "right").places == [(1, 0), (2, 1)], "both of its steps are undone"
    assert played.turn("backward", "right").places == [(2, 0), (2, 1)], "beside 1, after a step off the edge"
    # Forward is the cell of 1; from there agent 0 is moved on to its right.
    played = play("A...\n>^..\n....", pairwise_clashes=pairwise)
    assert played.turn("forward", "right").places == [(2, 1), (1, 1)]


def test_agent_0_is_moved_while_it_is_out_of_play_and_agent_1_out_of_play_moves_nobody():
    played = play("A....\n>.<..\n.....", freeze_steps=3).turn("stay", "beam")
    assert played.in_play == [False, True]
    assert played.turn("forward", "right").places == [(2, 0), (1, 2)], "its own action does not count"
    played = play("A....\n>.<..\n.....", freeze_steps=3).turn("beam", "stay")
    assert played.turn("stay", "right").places == [(1, 0), (1, 2)]


def test_agent_0_out_of_play_is_moved_even_onto_agent_1_and_then_waits_for_the_cell():
    played = play("A...\n>...\n^...", freeze_steps=3).turn("stay", "beam")
    assert played.turn("stay", "right").places == [(2, 0), (2, 0)]
    assert played.turn("stay").turn("stay").in_play == [False, True], "its time is over"
    assert played.turn("stay", "forward").in_play == [True, True]


def test_agent_0_bites_and_is_hit_where_it_ends_and_hits_from_where_it_fired():
    # 0 fires along row 0 at 1 and is moved down onto the apple; 2 fires along row 1.
    played = play(".>...<\n.A...<", beam_width_cells=1, hits_to_tag=2).turn("beam", "right", "beam")
    assert played.places == [(1, 1), (0, 5), (1, 5)]
    assert played.harvest == [1, 0, 0]
    assert np.argwhere(played.output.hit_by[0]).tolist() == [[0, 2], [1, 0]]


def test_the_picture_shows_the_beam_where_it_was_fired_for_that_turn_alone():
    played = play("A>...<\n.A....", beam_width_cells=1, hits_to_tag=2).turn("beam", "right")
    assert picture(played) == "A.bbbo\n.om..."
    assert picture(played.turn("beam", "stay")) == "A...mo\n.obbbb"


def test_a_beam_begins_at_agent_0_where_a_clash_or_the_edge_kept_it():
    blocked = play("....\n>...\n^..A", beam_width_cells=1).turn("beam", "right")
    assert (blocked.places[0], picture(blocked)) == ((1, 0), "....\nobbb\no..A")
    at_edge = play("^..A\n....\n>...", order=[1, 0], beam_width_cells=1).turn("beam", "right")
    assert (at_edge.places[0], picture(at_edge)) == ((2, 0), "o..A\n....\nobbb")


def test_an_agent_that_an_institution_kept_from_firing_has_no_beam_where_it_stood():
    played = play(
        ".>...<\n.A....", beam_width_cells=1, hits_to_tag=2, institutions=[Sanctioner(agents=(1,))]
    ).turn("beam", "right")
    assert picture(played) == "....mo\n.om..."
    assert not played.batch.now.moved_after_firing.any()


def test_a_loaded_state_shows_the_beam_where_it_was_fired():
    played = play(".>...<\n.A....", beam_width_cells=1, hits_to_tag=2).turn("beam", "right")
    other = Batch(played.game, 1)
    output = other.load(played.batch.state(), other.new_output())
    assert np.array_equal(output.observation, played.output.observation)
    assert np.array_equal(other.boards(output), played.batch.boards(played.output))


def test_only_states_of_games_with_the_fault_say_who_was_moved_after_firing():
    state = Batch(presets.game("two_complex", variant=VARIANT), 1).state()
    assert set(state) - set(NAMES) == {"moved_after_firing"}
    assert set(Batch(presets.game("two_complex", variant="as_run"), 1).state()) == set(NAMES)


def test_a_state_in_which_somebody_was_moved_who_had_not_fired_is_refused():
    batch = Batch(presets.game("two_complex", variant=VARIANT), 1)
    output = batch.begin(batch.new_output())
    for row, fired, fits in ((3, True, True), (3, False, False), (0, True, False)):
        state = batch.state()
        state["row"][0, 0], state["heading"][0, 0] = row, 1
        state["fired"][0, 0], state["moved_after_firing"][0, 0] = fired, True
        if fits:
            batch.load(state, output)
            continue
        with pytest.raises(ValueError, match=r"state\['moved_after_firing'\]\[0, 0\] is True"):
            batch.load(state, output)


def test_the_fault_needs_two_agents():
    message = "Rules.agent_1_right_moves_agent_0 is True and the map has 1 agent; allowed: at least 2"
    with pytest.raises(ValueError, match=message):
        Game(map=maps.named("single_basic"), rules=Rules(agent_1_right_moves_agent_0=True))


def test_the_program_of_10_april_is_that_of_later_with_the_fault_and_another_discount():
    game, later = (presets.game("two_complex", variant=variant) for variant in (VARIANT, "as_run"))
    mended = replace(game, rules=replace(game.rules, agent_1_right_moves_agent_0=False))
    assert game.rules.agent_1_right_moves_agent_0
    assert mended == later
    settings = presets.dqn_settings("two_complex", variant=VARIANT)
    assert settings.gamma == 0.999
    assert replace(settings, gamma=0.995) == presets.dqn_settings("two_complex", variant="as_run")
    assert presets.variant_of(game) == VARIANT
