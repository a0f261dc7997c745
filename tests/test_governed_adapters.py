"""Games with institutions through all adapters: the same rewards, payments, observations and decisions."""

from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from boards import random_actions
from governed import EVERYTHING, random_decisions
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from restorable import assert_restorable
from torchrl.envs import EnvBase, ParallelEnv, RewardSum, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps
from cprl.envs import CommonsGymnasiumEnv, env, make_env, parallel_env
from cprl.institutions import COUNTS, Boundaries, Monitoring, Quota, Tax, Vote

RICH = replace(
    EVERYTHING,
    observation=Observation(encoding="one_hot", agents_apart=True, scoreboard=True, stock_gauge=True),
)
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
FORMS = pytest.mark.parametrize("game", [EVERYTHING, RICH], ids=["rgb", "rich"])


@FORMS
def test_the_env_passes_torchrls_checks(game):
    check_env_specs(CommonsEnv(game, 3, state=True))
    decided = CommonsEnv(game, 3).rollout(30, break_when_any_done=False)
    assert decided[keys.DECISION].shape == (3, 30, 3)
    assert decided["next", *keys.COUNTS].shape == (3, 30, 3, len(COUNTS))
    assert decided["next", keys.IN_FORCE].shape == (3, 30, 4)
    assert decided["next", *keys.FINES].any()
    shown = decided["next", *keys.HARVEST] - decided["next", *keys.FINES] + decided["next", *keys.TRANSFERS]
    torch.testing.assert_close(decided["next", *keys.REWARD].squeeze(-1), shown, atol=1e-5, rtol=1e-5)


def test_a_game_without_institutions_has_none_of_their_entries():
    steps = CommonsEnv(replace(EVERYTHING, institutions=()), 2).rollout(3)
    names = {key if isinstance(key, str) else key[-1] for key in steps.keys(True, True)}
    assert not names & {"fines", "transfers", "violated", "counts", "decision", "in_force"}


@FORMS
def test_pettingzoos_tests_pass(game):
    parallel_api_test(parallel_env(game), num_cycles=60)
    parallel_seed_test(lambda: parallel_env(game), num_cycles=30)
    seed_test(lambda: env(game), num_cycles=60)
    if game is EVERYTHING:
        api_test(env(game), num_cycles=100)


def test_gymnasiums_check_passes():
    check_env(gymnasium.make("cprl/Commons-v0", game=ALONE).unwrapped, skip_render_check=True)


def of_torchrl(game, turns, decisions):
    """What the agents receive in each turn, and in which episode; decisions change with every turn."""
    adapter, episode = CommonsEnv(game, seed=5), 0
    moment, decided = adapter.reset(), decisions[0]
    for turn in turns:
        moment.set(keys.ACTION, torch.as_tensor(turn[None]))
        if game.decisions:
            moment.set(keys.DECISION, torch.as_tensor(decided[None]))
        now, moment = adapter.step_and_maybe_reset(moment)
        agents = now["next", "agents"][0]
        yield {
            "observation": agents["observation"].numpy(),
            "rewards": agents["reward"][:, 0].tolist(),
            **{name: agents[name].tolist() for name in ("fines", "transfers", "violated", "harvest")},
            "end": bool(now["next", "done"]),
        }
        if bool(now["next", "done"]):
            episode += 1
            decided = decisions[episode]


def received(names, seen, rewards, infos, end):
    """The same, from what the adapters for PettingZoo and Gymnasium return."""

    def window(name):
        return seen(name)["observation"] if isinstance(seen(name), dict) else seen(name)

    infos_of = {entry: [infos[n][entry] for n in names] for entry in ("fines", "transfers", "violated")}
    return {
        "observation": np.array([window(name) for name in names]),
        "rewards": [rewards[name] for name in names],
        **infos_of,
        "harvest": [infos[name]["harvest"] for name in names],
        "end": end,
    }


def options(names, decided):
    return {"decisions": dict(zip(names, map(int, decided), strict=True))}


def of_parallel_env(game, turns, decisions):
    adapter, names, episode = parallel_env(game, 5), game.agent_names, 0
    adapter.reset(options=options(names, decisions[0]))
    for turn in turns:
        seen, rewards, terminated, truncated, infos = adapter.step(dict(zip(names, turn, strict=True)))
        end = any(terminated.values()) or any(truncated.values())
        yield received(names, seen.get, rewards, infos, end)
        if end:
            episode += 1
            adapter.reset(options=options(names, decisions[episode]))


def of_aec_env(game, turns, decisions):
    adapter, names, episode = env(game, 5), game.agent_names, 0
    adapter.reset(options=options(names, decisions[0]))
    for turn in turns:
        for action in turn:
            adapter.step(action)
        end = adapter.terminations[names[0]] or adapter.truncations[names[0]]
        yield received(names, adapter.observe, adapter.rewards, adapter.infos, end)
        if end:
            episode += 1
            adapter.reset(options=options(names, decisions[episode]))


def of_gymnasium(game, turns, decisions):
    adapter, episode = CommonsGymnasiumEnv(game, seed=5), 0
    adapter.reset(options=options(["agent_0"], decisions[0]))
    for turn in turns:
        seen, reward, terminated, truncated, info = adapter.step(turn[0])
        end = terminated or truncated
        one = {"agent_0": reward}
        yield received(["agent_0"], {"agent_0": seen}.get, one, {"agent_0": info}, end)
        if end:
            episode += 1
            adapter.reset(options=options(["agent_0"], decisions[episode]))


@pytest.mark.parametrize("game", [EVERYTHING, RICH, ALONE], ids=["rgb", "rich", "alone"])
def test_all_adapters_show_and_pay_the_same(game):
    turns = random_actions(90, 1, game, seed=1)[:, 0]
    decisions = random_decisions(40, 1, game, seed=2)[:, 0]
    adapters = [of_parallel_env, of_aec_env, *([of_gymnasium] if game is ALONE else [])]
    paid, ends = set(), 0
    for number, (first, *others) in enumerate(
        zip(*(adapter(game, turns, decisions) for adapter in (of_torchrl, *adapters)), strict=True)
    ):
        for other in others:
            assert other.keys() == first.keys()
            for entry, value in first.items():
                assert np.array_equal(other[entry], value), (number, entry)
        ends += first["end"]
        paid |= set(first["rewards"])
    assert ends >= 3
    assert len(paid) > 5


def test_decisions_are_those_of_the_reset_in_pettingzoo_and_an_unnamed_agent_takes_the_first_option():
    game = replace(EVERYTHING, institutions=(Vote(on=Tax(redistribution="none"), choices=(0.0, 0.5, 1.0)),))
    adapter = parallel_env(game)
    for decisions, rate in (({"agent_0": 2, "agent_2": 1}, 0.5), ({"agent_1": 2}, 0.0), ({}, 0.0)):
        adapter.reset(options={"decisions": decisions})
        adapter.step(dict.fromkeys(game.agent_names, 0))
        assert adapter.payments.in_force.tolist() == [[rate]]
    adapter.reset()
    adapter.step(dict.fromkeys(game.agent_names, 0))
    assert adapter.payments.in_force.tolist() == [[0.0]]


def test_the_lean_step_and_maybe_reset_equals_torchrls_own_and_keeps_decisions():
    lean, stock = (CommonsEnv(EVERYTHING, worlds=4, seed=2, state=True) for _ in range(2))
    moment, other_moment = lean.reset(), stock.reset()
    turns = torch.as_tensor(random_actions(60, 4, EVERYTHING))
    decisions = torch.as_tensor(random_decisions(60, 4, EVERYTHING))
    for turn, decided in zip(turns, decisions, strict=True):
        for entry in (moment, other_moment):
            entry[keys.ACTION], entry[keys.DECISION] = turn, decided
        now, moment = lean.step_and_maybe_reset(moment)
        other_now, other_moment = EnvBase._step_and_maybe_reset(stock, other_moment)
        for one, other in ((now, other_now), (moment, other_moment)):
            assert set(one.keys(True, True)) == set(other.keys(True, True))
            for key in one.keys(True, True):
                assert torch.equal(one[key], other[key]), key


def test_an_entry_of_an_earlier_turn_never_changes():
    adapter = CommonsEnv(EVERYTHING, worlds=3, seed=2)
    steps = adapter.rollout(5, break_when_any_done=False)
    kept, copy = steps[:, 1]["next"], steps[:, 1]["next"].clone()
    adapter.rollout(20, break_when_any_done=False)
    assert (kept == copy).all()


def test_a_reset_of_some_worlds_keeps_what_others_were_paid():
    adapter = CommonsEnv(EVERYTHING, worlds=3, seed=2)
    last = adapter.rollout(9, break_when_any_done=False)[:, -1]["next"]
    which = torch.tensor([[True], [False], [False]])
    after = adapter.reset(last.clone().set("_reset", which))
    for key in (keys.FINES, keys.TRANSFERS, keys.VIOLATED, keys.COUNTS, keys.IN_FORCE, keys.OBSERVATION):
        assert torch.equal(after[key][1:], last[key][1:]), key
    assert not after[keys.COUNTS][0].any()
    assert last[keys.COUNTS][0].any()


def test_what_was_kept_is_restored_whole():
    assert_restorable(lambda: CommonsEnv(EVERYTHING, 3, seed=4))
    assert_restorable(lambda: make_env(RICH, worlds=2, seed=4, transforms=[StepCounter()]))


def of_workers(kind, turns, decisions):
    """What two workers of three worlds each play."""
    vec = kind(2, [partial(CommonsEnv, EVERYTHING, 3, seed=seed) for seed in (1, 2)])
    try:
        moment, found = vec.reset(), []
        for turn, decided in zip(turns, decisions, strict=True):
            moment[keys.ACTION], moment[keys.DECISION] = turn, decided
            now, moment = vec.step_and_maybe_reset(moment)
            found.append(now["next"].clone())
        return found
    finally:
        vec.close()


# Forked, as in test_torchrl_env.py.
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    "kind",
    [pytest.param(partial(ParallelEnv, mp_start_method="fork"), marks=pytest.mark.slow), SerialEnv],
    ids=["ParallelEnv", "SerialEnv"],
)
def test_torchrls_vectors_of_envs_play_the_same(kind):
    turns = torch.as_tensor(random_actions(40, 6, EVERYTHING)).view(40, 2, 3, 3)
    decisions = torch.as_tensor(random_decisions(40, 6, EVERYTHING)).view(40, 2, 3, 3)
    played = of_workers(kind, turns, decisions)
    for worker, seed in enumerate((1, 2)):
        adapter = CommonsEnv(EVERYTHING, 3, seed=seed)
        moment = adapter.reset()
        for turn, decided, found in zip(turns[:, worker], decisions[:, worker], played, strict=True):
            moment[keys.ACTION], moment[keys.DECISION] = turn, decided
            now, moment = adapter.step_and_maybe_reset(moment)
            for key in now["next"].keys(True, True):
                assert torch.equal(now["next"][key], found[worker][key]), key


def test_torchrls_reward_sum_adds_up_what_agents_are_paid():
    adapter = TransformedEnv(
        CommonsEnv(EVERYTHING, 2, seed=1), RewardSum(in_keys=[keys.REWARD], out_keys=[("agents", "total")])
    )
    steps = adapter.rollout(20, break_when_any_done=False)
    paid = steps["next", *keys.REWARD].sum(1)
    torch.testing.assert_close(steps["next", "agents", "total"][:, -1], paid, atol=1e-5, rtol=1e-5)
