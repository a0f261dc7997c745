"""The forms of observations."""

from dataclasses import replace

import numpy as np
import pytest
from boards import Play, drawn, only_quirks, random_actions
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps, presets
from cprl.commons.batch import Batch
from cprl.commons.cells import CLASS_COLOURS, FIRST_AGENT, MAX_AGENTS_APART, class_colour
from cprl.institutions import Quota

BOARD = """
    A..#.A
    .v....
    ...<.^
"""
FORMS = [
    Observation(area=area, encoding=encoding, agents_apart=apart, scoreboard=apart, stock_gauge=not apart)
    for area in ("window", "full")
    for encoding in ("rgb", "one_hot")
    for apart in (False, True)
]


@pytest.mark.parametrize("encoding", ["rgb", "one_hot"])
def test_a_full_observation_shows_the_whole_board_with_the_observer_as_self(encoding):
    play = Play(BOARD, observation=Observation(area="full", encoding=encoding))
    assert play.window(0) == drawn("A..#.A\n.S...m\n.mmo.o")
    assert play.window(2) == drawn("A..#.A\n.o...m\n.mmo.S")
    form = Observation(area="full", encoding=encoding, agents_apart=True)
    apart = Play(BOARD, observation=form)
    assert apart.window(0) == drawn("A..#.A\n.S...m\n.mm1.2"), "each other agent in its own colour"
    assert apart.window(1) == drawn("A..#.A\n.0...m\n.mmS.2")


@pytest.mark.parametrize("area", ["window", "full"])
@pytest.mark.parametrize("apart", [False, True])
def test_one_hot_and_rgb_observations_show_the_same_cells(area, apart):
    colours, channels = (
        Play(
            BOARD,
            observation=Observation(area=area, encoding=encoding, agents_apart=apart),
            window_rows=3,
            window_columns=5,
            regrow_prob=(0.1, 0.5),
            freeze_steps=3,
        )
        for encoding in ("rgb", "one_hot")
    )
    for turn in random_actions(60, 1, colours.game, seed=1):
        for play in (colours, channels):
            play.turn(*(play.game.actions[action] for action in turn[0]))
        for agent in range(3):
            assert colours.window(agent) == channels.window(agent)


def test_channels_have_the_names_of_colours_or_classes():
    def names(**form):
        return Game(map=maps.parse(BOARD), rules=Rules(), observation=Observation(**form)).channels

    common = ("ground", "wall", "apple", "heading", "beam")
    assert names() == ("red", "green", "blue")
    assert names(encoding="one_hot") == (*common, "other", "self")
    apart = names(encoding="one_hot", agents_apart=True)
    assert apart == (*common, "self", "agent_0", "agent_1", "agent_2")


def test_identity_colours_differ_from_each_other_and_from_the_colours_of_classes():
    colours = [class_colour(FIRST_AGENT + agent) for agent in range(MAX_AGENTS_APART)]
    assert len({*colours, *CLASS_COLOURS}) == MAX_AGENTS_APART + len(CLASS_COLOURS)


def test_agents_apart_refuses_too_many_agents():
    many = maps.parse(f"A{'>' * (MAX_AGENTS_APART + 1)}")
    Game(map=many, rules=Rules())
    with pytest.raises(ValueError, match="121 agents; allowed: at most 120"):
        Game(map=many, rules=Rules(), observation=Observation(agents_apart=True))


def test_planes_hold_the_scoreboard_and_the_stock_gauge_scaled():
    planes = Observation(scoreboard=True, stock_gauge=True)
    play = Play("A>A.A<.>A", observation=planes, window_rows=2, window_columns=3)
    assert play.game.channels == ("red", "green", "blue", "scoreboard", "stock_gauge")
    play.turn("forward", "forward", "stay")
    play.turn("backward", "stay", "stay")
    play.turn("backward", "stay", "stay")
    two, one = 85, 51  # 255 x 2 / (2 + 4 sites), 255 x 1 / (1 + 4)
    for seen, board in zip(
        play.output.observation[0], ([two, one, 0], [one, 0, two], [0, two, one]), strict=True
    ):
        assert seen[3].tolist() == [board, board], "by row: the observer, the next index, the one after"
        assert (seen[4] == 64).all(), "255 x 1 / 4, rounded"
    play.again()
    assert not play.output.observation[0, :, 3].any()
    assert (play.output.observation[0, :, 4] == 255).all()


def test_a_scoreboard_of_more_agents_than_cells_takes_several_planes():
    full, form = Observation(area="full", scoreboard=True), Observation(scoreboard=True)
    assert Play(">A\n<v", observation=full).game.channels == ("red", "green", "blue", "scoreboard")
    play = Play(">A\n<v", observation=form, window_rows=1, window_columns=1)
    assert play.game.channels == ("red", "green", "blue", *["scoreboard"] * 3)
    play.turn("forward", "stay", "stay")
    assert play.output.observation[0, :, 3:].reshape(3, 3).tolist() == [
        [128, 0, 0],
        [0, 0, 128],
        [0, 128, 0],
    ], "255 x 1 / (1 + 1 site), rounded"


@pytest.mark.parametrize("institutions", [(), (Quota(share=0.25, window_steps=20),)], ids=["free", "quota"])
@pytest.mark.parametrize("encoding", ["rgb", "one_hot"])
@pytest.mark.parametrize("area", ["window", "full"])
def test_planes_show_harvests_and_stock_and_change_nothing_else(area, encoding, institutions):
    form = Observation(area=area, encoding=encoding)
    without = replace(presets.game("commons"), institutions=institutions, observation=form)
    planes = replace(without, observation=replace(form, scoreboard=True, stock_gauge=True))
    check_env_specs(CommonsEnv(planes, 2, seed=1))
    assert planes.spaces.observation_scale == 255, "networks divide by it"
    batches = [Batch(game, 2, seed=3) for game in (without, planes)]
    outputs = [batch.begin() for batch in batches]
    first, sites = len(planes.cell_channels), len(planes.map.sites)
    harvest = np.zeros((2, 4))
    seen = 0
    for turn in random_actions(60, 2, planes):
        shown, drawn = (batch.play(turn, out) for batch, out in zip(batches, outputs, strict=True))
        scores = drawn.observation[:, :, first].reshape(2, 4, -1)
        harvest += shown.harvest
        for entry in range(4):
            apples = np.roll(harvest, -entry, axis=1)
            expected = np.floor(255 * apples / (apples + sites) + 0.5)
            assert (scores[:, :, entry::4] == expected[..., None]).all()
        stock = np.floor(255 * shown.stock / sites + 0.5)
        assert (drawn.observation[:, :, first + 1] == stock[..., None, None]).all()
        rest = np.delete(drawn.observation, [first, first + 1], axis=2)
        scale = planes.observation_highest // without.observation_highest
        assert np.array_equal(rest, shown.observation * scale)
        assert np.array_equal(drawn.harvest, shown.harvest)
        seen = max(seen, int(scores.max()))
    assert seen > 0


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_specs_match_the_form_of_the_observation(form):
    env = CommonsEnv(replace(presets.game("commons"), observation=form), worlds=2, seed=1, state=True)
    check_env_specs(env)
    moment = env.reset()
    channels, rows, columns = env.game.observation_shape
    assert channels == len(env.game.channels)
    assert moment[keys.OBSERVATION].shape == (2, 4, channels, rows, columns)
    assert (rows, columns) == ((12, 24) if form.area == "full" else (7, 15))
    assert ("scoreboard" in env.game.channels) == form.scoreboard
    assert ("stock_gauge" in env.game.channels) == form.stock_gauge
    assert moment[keys.OBSERVATION].max() <= env.observation_spec[keys.OBSERVATION].space.high.max()


def test_the_form_of_the_observation_does_not_change_the_game():
    game = presets.game("commons", variant="as_run")
    batches = [Batch(replace(game, observation=form), 2) for form in (Observation(), *FORMS)]
    outputs = [batch.begin() for batch in batches]
    for turn in random_actions(100, 2, game):
        plain, *others = (batch.play(turn, out) for batch, out in zip(batches, outputs, strict=True))
        for form, other in zip(FORMS, others, strict=True):
            assert np.array_equal(other.harvest, plain.harvest)
            assert np.array_equal(other.stock, plain.stock)
            if form == Observation(stock_gauge=True):
                assert np.array_equal(other.observation[:, :, :3], plain.observation)


def test_under_paint_over_an_entry_says_whether_an_apple_is_ahead_of_an_agent():
    play = Play(">A.\n.^A\nA.<", quirks=only_quirks(paint_over=True))
    assert play.output.apple_ahead[0].tolist() == [[True], [True], [False]]
    play.turn("forward", "turn_left", "turn_right")
    assert play.output.apple_ahead[0].tolist() == [[False], [False], [True]]
    assert check_env_specs(CommonsEnv(play.game, 2)) is None
    for variant in ("published", "as_run"):
        moment = CommonsEnv(presets.game("commons", variant=variant)).reset()
        assert (keys.APPLE_AHEAD in moment.keys(True)) == (variant == "as_run")
