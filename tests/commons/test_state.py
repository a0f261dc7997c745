"""The state of a batch is read and set as plain arrays; an impossible state is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from boards import assert_same, copied, random_actions
from governed import EVERYTHING

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps, presets
from cprl.commons.batch import Batch
from cprl.institutions.arrays import state_arrays

OF_WORLDS = ("seed", "number", "episode", "step", "ended", "stock")
OF_AGENTS = (
    *("row", "col", "heading", "in_play", "out_steps", "on_board", "harvested"),
    *(
        "fired",
        "shot_row",
        "shot_col",
        "shot_heading",
        "cooldown",
        "signal",
        "hits",
        "tagged_step",
        "offences",
    ),
)
GAME = Game(
    map=maps.parse("A>.A.\n.#.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), freeze_steps=3, episode_steps=50, window_rows=3, window_columns=3),
)


def played_batch(game, worlds=3, steps=40, **how):
    batch = Batch(game, worlds, **how)
    output = batch.begin()
    for turn in random_actions(steps, worlds, game):
        batch.play(turn, output)
    return batch, output


@pytest.mark.parametrize(("board", "variant"), presets.GAMES)
def test_a_batch_that_loads_a_state_continues_like_the_original(board, variant):
    game = presets.game(board, variant=variant)
    game = Game(map=game.map, rules=game.rules, observation=Observation(scoreboard=True))
    batch, output = played_batch(game, seed=5)
    other = Batch(game, 3, seed=77, first_world=9)
    shown = other.load(batch.state())
    assert_same(other.now, batch.now)
    for name in ("observation", "in_play", "stock", "terminated", "truncated", "done"):
        assert np.array_equal(getattr(shown, name), getattr(output, name)), name
    assert not shown.harvest.any()
    for turn in random_actions(60, 3, game, seed=2):
        assert_same(batch.play(turn, output), other.play(turn, shown))
    assert_same(other.now, batch.now)
    assert_same(batch.begin(output), other.begin(shown))


def test_a_state_is_a_copy_of_plain_arrays():
    batch, _ = played_batch(GAME)
    state = batch.state()
    assert sorted(state) == sorted(OF_WORLDS + OF_AGENTS)
    assert all(type(array) is np.ndarray for array in state.values())
    before = copied(batch.now)
    for array in state.values():
        array[:] = 1
    assert_same(batch.now, before)


def test_an_environment_loads_the_state_of_another_and_returns_its_observation():
    env, other = CommonsEnv(GAME, 2, seed=1), CommonsEnv(GAME, 2, seed=8)
    moment = env.rollout(5, break_when_any_done=False)[:, -1]["next"]
    shown = other.load(env.worlds.state())
    assert torch.equal(shown[keys.OBSERVATION], moment[keys.OBSERVATION])
    assert torch.equal(shown[keys.STOCK], moment[keys.STOCK])
    actions = torch.tensor([[0, 1], [2, 3]])
    after = [
        one.step(entry.set(keys.ACTION, actions))["next"]
        for one, entry in ((env, moment.exclude(keys.REWARD)), (other, shown))
    ]
    assert (after[0] == after[1]).all()


def test_events_of_the_turn_before_are_not_told_but_windows_show_its_beams():
    env = CommonsEnv(GAME, 1, seed=1)
    moment = env.reset()
    beams = torch.full((1, 2), GAME.actions.index("beam"))
    after = env.step(moment.set(keys.ACTION, beams))["next"]
    assert after[keys.FIRED].all()
    state = env.worlds.state()
    assert state["fired"].all()
    shown = env.load(state)
    assert torch.equal(shown[keys.OBSERVATION], after[keys.OBSERVATION])
    for key in (keys.HARVEST, keys.FIRED, keys.HIT_BY, keys.TAGGED_BY, keys.REGROWN):
        assert not shown[key].any(), key


@pytest.mark.parametrize(
    ("game", "change", "message"),
    [
        (GAME, {"row": 3}, r"state\['row'\]\[0, 0\] is 3; allowed: 0 to 2"),
        (GAME, {"col": -1}, r"state\['col'\]\[0, 0\] is -1; allowed: 0 to 4"),
        (GAME, {"heading": 4}, r"state\['heading'\]\[0, 0\] is 4; allowed: 0 to 3"),
        (GAME, {"stock": 2}, r"state\['stock'\]\[0, 0\] is 2; allowed: 0 to 1"),
        (GAME, {"out_steps": -1}, r"state\['out_steps'\]\[0, 0\] is -1; allowed: 0 to"),
        (GAME, {"hits": 1}, r"state\['hits'\]\[0, 0\] is 1; allowed: 0 to 0"),
        (GAME, {"step": 51}, r"state\['step'\]\[0, 0\] is 51; allowed: 0 to 50"),
        (GAME, {"ended": 3}, r"state\['ended'\]\[0, 0\] is 3; allowed: 0 to 2"),
        (EVERYTHING, {"taken": -1}, r"state\['taken'\]\[0, 0, 0\] is -1; allowed: 0 to 25"),
        (EVERYTHING, {"taken": 26}, r"state\['taken'\]\[0, 0, 0\] is 26; allowed: 0 to 25"),
        (EVERYTHING, {"level": -1}, r"state\['level'\]\[0, 0\] is -1"),
        (EVERYTHING, {"offence_step": 26}, r"state\['offence_step'\]\[0, 0\] is 26; allowed: 0 to 25"),
        (EVERYTHING, {"violation_step": -2}, r"state\['violation_step'\]\[0, 0\] is -2; allowed: 0 to 25"),
        (EVERYTHING, {"counts": -1}, r"state\['counts'\]\[0, 0, 0\] is -1"),
        (EVERYTHING, {"allowed": np.nan}, r"state\['allowed'\]\[0, 0\] is nan"),
        (EVERYTHING, {"income": np.inf}, r"state\['income'\]\[0, 0, 0\] is inf"),
    ],
)
def test_a_state_out_of_range_is_refused_and_changes_nothing(game, change, message):
    batch = Batch(game, 2)
    output = batch.begin()
    state, before, worlds = batch.state(), batch.state(), copied(batch.now)
    for name, value in change.items():
        state[name].reshape(-1)[0] = value
    with pytest.raises(ValueError, match=message):
        batch.load(state, output)
    assert all(np.array_equal(array, before[name]) for name, array in batch.state().items())
    assert_same(batch.now, worlds)


def test_a_state_from_before_the_first_episode_can_be_put_back():
    batch, other = Batch(EVERYTHING, 2), Batch(EVERYTHING, 2)
    other.load(batch.state())
    assert all(np.array_equal(array, other.state()[name]) for name, array in batch.state().items())


def test_a_state_with_other_names_shapes_or_dtypes_is_refused():
    batch, governed = Batch(GAME, 2), Batch(EVERYTHING, 2)
    output, state = batch.begin(), batch.state()
    for name, wrong, message in (
        ("line", state["row"], r"lacks \[\] and has the unknown entries \['line'\]"),
        ("row", state["row"].astype(np.int64), r"state\['row'\] is int64 \[2, 2\]; allowed: int32 \[2, 2\]"),
        ("row", state["row"][:1], r"state\['row'\] is int32 \[1, 2\]; allowed: int32 \[2, 2\]"),
    ):
        with pytest.raises(ValueError, match=message):
            batch.load({**state, name: wrong}, output)
    with pytest.raises(ValueError, match=r"has the unknown entries \['allowed', 'counts'"):
        batch.load(governed.state(), output)
    with pytest.raises(ValueError, match=r"the state lacks \['allowed', 'counts'"):
        governed.load(state)


HOT = replace(GAME, rules=replace(GAME.rules, cooldown_steps=3, signals=2, hits_to_tag=2))


@pytest.mark.parametrize("game", [HOT, EVERYTHING, presets.game("ssd/cleanup-v1")], ids=str)
def test_what_is_declared_as_cleared_is_0_when_an_episode_begins(game):
    batch, output = played_batch(game, worlds=20, steps=20)
    if game is HOT:
        assert all(batch.state()[name].any() for name in ("cooldown", "signal", "hits", "shot_row"))
    batch.begin(output)
    for arrays in filter(None, (batch.now, batch.law)):
        for name, array, how in state_arrays(arrays):
            assert not how.cleared or not array.any(), name


def test_groups_of_rules_add_what_they_remember():
    for board, variant, names in (
        ("commons", "as_run", {"stock_before"}),
        ("commons", "published", set()),
    ):
        batch = Batch(presets.game(board, variant=variant), 1)
        assert set(batch.state()) == {*OF_WORLDS, *OF_AGENTS, *names}
    assert {"waste", "cleans"} <= set(Batch(presets.game("ssd/cleanup-v1"), 1).state())


def test_as_run_a_state_may_have_two_agents_on_a_cell():
    game = presets.game("two_complex", variant="as_run")
    batch = Batch(game, 1)
    output, state = batch.begin(), batch.state()
    state["row"][:], state["col"][:] = 3, 3
    batch.load(state, output)
    assert batch.now.row.tolist() == [[3, 3]]
