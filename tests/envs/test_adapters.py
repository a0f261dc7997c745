"""The adapters for PettingZoo and Gymnasium keep their contracts, and all adapters play the same game."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from boards import random_actions
from governed import EVERYTHING, random_decisions
from gymnasium.utils.env_checker import check_env
from pettingzoo import ParallelEnv
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from torchrl.envs import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps, presets
from cprl.commons.cells import BEAM
from cprl.envs import CommonsGymnasiumEnv, env, parallel_env
from cprl.institutions import Boundaries, Monitoring, Quota, Tax, Vote
from cprl.pictures.colours import PALETTE

SHORT = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.1), window_rows=3, window_columns=5, episode_steps=30, freeze_steps=3),
)
RICH = Observation(encoding="one_hot", agents_apart=True, scoreboard=True, stock_gauge=True)
ALONE = Game(
    map=maps.parse(">AA.\nA.A."),
    rules=Rules(regrow_prob=(0.1, 0.5), may_fire=False, window_rows=3, window_columns=3, episode_steps=20),
    institutions=(
        Vote(on=Tax(redistribution="none", period_steps=3), choices=(0.0, 0.25, 0.5)),
        Quota(share=0.5, window_steps=5, fine=1),
        Boundaries.drawn("..-.\n....", owners=("",), step_fine=0.5, bite_fine=0.25),
        Monitoring(prob=0.5, cost=0.1),
    ),
)
RULED = replace(EVERYTHING, observation=RICH)
GAMES = [
    SHORT,
    replace(SHORT, observation=RICH),
    presets.game("commons", variant="as_run"),
    EVERYTHING,
    RULED,
]
IDS = ["short", "rich", "commons", "institutions", "institutions, rich"]
SINGLE = [presets.game("single_basic"), replace(presets.game("single_complex"), observation=RICH), ALONE]


@pytest.mark.parametrize("game", GAMES, ids=IDS)
def test_both_envs_pass_pettingzoos_tests_of_their_interface_and_seeds(game):
    parallel_api_test(parallel_env(game), num_cycles=100)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        api_test(env(game), num_cycles=200)
    assert not caught, "observations are a box"
    parallel_seed_test(lambda: parallel_env(game), num_cycles=60)
    seed_test(lambda: env(game), num_cycles=60)


def test_the_aec_env_passes_pettingzoos_render_test_without_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    parallel_api_test(parallel_env(SHORT, render_mode="rgb_array"), num_cycles=100)
    render_test(lambda render_mode: env(SHORT, render_mode="rgb_array"))  # it also asks for "human"


@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
@pytest.mark.parametrize("game", SINGLE, ids=["single_basic", "rich", "institutions"])
def test_the_gymnasium_env_passes_gymnasiums_check_without_a_display(game, render_mode, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    check_env(gymnasium.make("cprl/Commons-v0", game=game, render_mode=render_mode).unwrapped)


@pytest.mark.parametrize(
    ("name", "board"), [("SingleBasic", "single_basic"), ("SingleComplex", "single_complex")]
)
@pytest.mark.parametrize("variant", ["published", "as_run"])
def test_single_boards_are_registered_in_both_variants(name, board, variant):
    made = gymnasium.make(f"cprl/{name}-v0", variant=variant)
    assert made.unwrapped.game == presets.game(board, variant=variant)


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using version:UserWarning")
def test_torchrls_pettingzoo_wrapper_accepts_the_parallel_env():
    wrapped = PettingZooWrapper(parallel_env(presets.game("commons")), use_mask=False)
    check_env_specs(wrapped)
    steps = wrapped.rollout(20)
    assert steps["agent", "observation"].shape == (20, 4, 3, 7, 15)


INFOS = ("harvest", "in_play", "fired", "fines", "transfers", "violated")


def played_by_torchrl(game, turns, decisions):
    """What the agents receive in each turn; when an episode has ended, the next begins with the next
    decisions."""
    adapter, episode = CommonsEnv(game, seed=5), 0
    moment = adapter.reset()
    for turn in turns:
        moment.set(keys.ACTION, torch.as_tensor(turn[None]))
        if game.decisions:
            moment.set(keys.DECISION, torch.as_tensor(decisions[episode][None]))
        now, moment = adapter.step_and_maybe_reset(moment)
        after = now["next"]
        agents = after["agents"][0]
        episode += bool(after["done"])
        yield {
            **{
                (name, "observation"): agents[i]["observation"].numpy()
                for i, name in enumerate(game.agent_names)
            },
            **{name: agents[name].tolist() for name in INFOS if name in agents},
            "rewards": agents["reward"][:, 0].tolist(),
            "tagged": agents["tagged_by"].any(-1).tolist(),
            "end": (bool(after["terminated"]), bool(after["truncated"])),
        }


def step_output(names, observe, rewards, infos, end):
    """The same, from what the adapters for PettingZoo and Gymnasium return."""
    entries = {(name, "observation"): observe(name) for name in names}
    entries |= {entry: [infos[name][entry] for name in names] for entry in infos[names[0]]}
    return {**entries, "rewards": [rewards[name] for name in names], "end": end}


def options(game, decided):
    """What agents decide, as `reset` takes it."""
    decisions = dict(zip(game.agent_names, map(int, decided), strict=True))
    return {"decisions": decisions if game.decisions else {}}


def stepped_in_parallel(world, names, actions):
    seen, rewards, terminated, truncated, infos = world.step(dict(zip(names, actions, strict=True)))
    (end,) = set(zip(terminated.values(), truncated.values(), strict=True))
    assert world.agents == ([] if any(end) else list(names))
    return seen.get, rewards, infos, end


def stepped_in_turn(world, names, actions):
    for name, action in zip(names, actions, strict=True):
        assert world.agent_selection == name
        world.step(action)
    return world.observe, world.rewards, world.infos, (world.terminations[name], world.truncations[name])


def stepped_alone(world, names, actions):
    seen, reward, *end, info = world.step(actions[0])
    return {"agent_0": seen}.get, {"agent_0": reward}, {"agent_0": info}, tuple(end)


def played(make, step, game, turns, decisions):
    world, episode = make(game, seed=5), 0
    world.reset(options=options(game, decisions[0]))
    for turn in turns:
        observe, rewards, infos, end = step(world, game.agent_names, turn.tolist())
        yield step_output(game.agent_names, observe, rewards, infos, end)
        if any(end):
            episode += 1
            world.reset(options=options(game, decisions[episode]))


BY_ALL = {
    f"{board}, {name}": replace(
        (game := presets.game(board)), rules=replace(game.rules, episode_steps=130), observation=form
    )
    for board in presets.BOARDS
    for name, form in (("rgb", Observation()), ("rich", RICH))
}
BY_ALL |= {"institutions": EVERYTHING, "institutions, rich": RULED, "institutions, alone": ALONE}


@pytest.mark.parametrize("game", BY_ALL.values(), ids=BY_ALL)
def test_all_adapters_play_the_same_game_for_the_same_seed(game):
    turns = random_actions(300, 1, game, seed=1)[:, 0]
    decisions = random_decisions(99, 1, game, seed=2)[:, 0]
    adapters = [(parallel_env, stepped_in_parallel), (env, stepped_in_turn)]
    adapters += [(CommonsGymnasiumEnv, stepped_alone)] if game.agents == 1 else []
    others = [played(*adapter, game, turns, decisions) for adapter in adapters]
    ends, paid = 0, set()
    for number, outputs in enumerate(zip(played_by_torchrl(game, turns, decisions), *others, strict=True)):
        for other in outputs[1:]:
            assert set(other) == set(outputs[0])
            for entry, value in outputs[0].items():
                assert np.array_equal(other[entry], value), (number, entry)
        ends += any(outputs[0]["end"])
        paid |= set(outputs[0]["rewards"])
    assert number == 299
    assert ends >= 2
    assert not game.institutions or len(paid) > 5


def test_decisions_are_those_of_the_reset_in_pettingzoo_and_an_unnamed_agent_takes_the_first_option():
    game = replace(EVERYTHING, institutions=(Vote(on=Tax(redistribution="none"), choices=(0.0, 0.5, 1.0)),))
    adapter = parallel_env(game)
    cases = ({"agent_0": 2, "agent_2": 1}, 0.5), ({"agent_1": 2}, 0.0), ({}, 0.0), (None, 0.0)
    for decisions, rate in cases:
        adapter.reset(options=None if decisions is None else {"decisions": decisions})
        adapter.step(dict.fromkeys(game.agent_names, 0))
        assert adapter.output.in_force.tolist() == [[rate]]


@pytest.mark.parametrize("adapter", [parallel_env, CommonsGymnasiumEnv])
def test_reset_with_a_seed_restarts_and_without_one_begins_the_next_episode(adapter):
    game = presets.game("single_complex")
    turns = random_actions(200, 1, game, seed=4)[:, 0, 0].tolist()

    def episode(world, **how):
        world.reset(**how)
        for turn in turns:
            world.step({"agent_0": turn} if isinstance(world, ParallelEnv) else turn)
        played = getattr(world, "world", world)
        return played.state().tolist(), played.batch.now.harvested.tolist()

    world = adapter(game)
    first = episode(world, seed=7)
    second = episode(world)
    assert episode(world, seed=8) != first != second
    assert episode(world, seed=7) == first
    assert episode(world) == second
    assert episode(adapter(game, seed=7)) == first


def test_the_image_shows_each_agent_in_play_in_its_own_colour():
    world = parallel_env(Game(map=maps.parse(">..<A"), rules=Rules(freeze_steps=3)), render_mode="rgb_array")
    world.reset()
    before = world.render()
    world.step({"agent_0": 6, "agent_1": 7})
    after = world.render()
    assert before.shape == (25, 121, 3)
    own = before[3, 3], before[3, 75]
    assert own[0].tolist() != own[1].tolist()
    assert after[3, 3].tolist() == own[0].tolist()
    assert after[3, 75].tolist() != own[1].tolist(), "agent 1 is out of play"
    assert (after == PALETTE[BEAM]).all(-1).any(), "the beam is drawn"


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"agent_0": 0}, r"actions has the agents \['agent_0'\]; allowed: exactly "),
        ({"agent_0": 0, "agent_1": 0, "agent_2": 0}, "allowed: exactly "),
        ({"agent_0": 0, "agent_1": 8}, "the action of agent_1 is 8"),
    ],
)
def test_wrong_actions_are_refused_and_change_nothing(actions, message):
    world = parallel_env(SHORT)
    world.reset()
    before = world.state()
    with pytest.raises(ValueError, match=message):
        world.step(actions)
    assert np.array_equal(world.state(), before)
    assert world.batch.now.step[0, 0] == 0


@pytest.mark.parametrize("actions", [{"agent_0": 0, "agent_1": 0}, {}])
def test_before_the_first_episode_and_after_each_a_reset_is_asked_for(actions):
    world = parallel_env(replace(SHORT, rules=replace(SHORT.rules, episode_steps=1)), render_mode="rgb_array")
    for attempt in (lambda: world.step(actions), world.render, world.state):
        with pytest.raises(ValueError, match=r"has not begun; allowed: reset\(\)"):
            attempt()
    world.reset()
    world.step({"agent_0": 0, "agent_1": 0})
    with pytest.raises(ValueError, match=r"has ended; allowed: reset\(\)"):
        world.step(actions)


def test_gymnasium_refuses_games_of_several_agents():
    with pytest.raises(ValueError, match="the game has 2 agents; allowed with Gymnasium: 1"):
        CommonsGymnasiumEnv(SHORT)


@pytest.mark.parametrize("mode", ["ansi", "human"])
def test_render_modes_are_checked(mode):
    with pytest.raises(ValueError, match="render_mode"):
        parallel_env(SHORT, render_mode=mode)
    world = parallel_env(SHORT)
    world.reset()
    with pytest.raises(ValueError, match="render_mode"):
        world.render()


def test_without_a_seed_two_environments_play_different_worlds():
    for make in (lambda: parallel_env(SHORT), lambda: CommonsGymnasiumEnv(SINGLE[0]).world):
        first, second = (make().batch.state()["seed"].item() for _ in range(2))
        assert first != second
