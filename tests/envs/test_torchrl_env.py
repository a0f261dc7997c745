"""CommonsEnv keeps TorchRL's contracts, and plays the very game of `cprl.commons`."""

from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from boards import random_actions
from governed import EVERYTHING as GOVERNED, random_decisions
from onlookers import ByWindow
from restorable import assert_restorable
from tensordict import TensorDict, assert_close
from torchrl.collectors import Collector
from torchrl.envs import (
    DTypeCastTransform,
    EnvBase,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TimeMaxPool,
    VecNormV2,
)
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps, presets
from cprl.envs import make_env
from cprl.envs.env_state import load_transforms_state, transforms_state
from cprl.institutions import COUNT_NAMES
from cprl.system.compat.torchrl import LeanStepEnv
from cprl.system.jit.compiled import runs_plain

SHORT = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.1), window_rows=3, window_columns=5, episode_steps=9),
)
RICH = replace(
    GOVERNED,
    observation=Observation(encoding="one_hot", agents_apart=True, scoreboard=True, stock_gauge=True),
)
LITERATURE = ("melting_pot/commons_harvest__open-v1", "ssd/cleanup-v1")
EVERYTHING = {  # key -> shape without B, dtype
    keys.OBSERVATION: ((4, 3, 7, 15), torch.uint8),
    keys.HARVEST: ((4,), torch.float32),
    keys.IN_PLAY: ((4,), torch.bool),
    keys.FIRED: ((4,), torch.bool),
    keys.HIT_BY: ((4, 4), torch.bool),
    keys.TAGGED_BY: ((4, 4), torch.bool),
    keys.STOCK: ((1,), torch.int64),
    keys.REGROWN: ((1,), torch.int64),
    keys.STATE: ((3, 12, 24), torch.uint8),
    keys.DONE: ((1,), torch.bool),
    keys.TERMINATED: ((1,), torch.bool),
    keys.TRUNCATED: ((1,), torch.bool),
}
CHOSEN = (keys.ACTION, keys.DECISION, (keys.AGENTS, "value"), "note")
VECTORS = pytest.mark.parametrize(
    "kind",
    [pytest.param(partial(ParallelEnv, mp_start_method="fork"), marks=pytest.mark.slow), SerialEnv],
    ids=["ParallelEnv", "SerialEnv"],
)


def as_floats():
    """Observations as normalisations want them."""
    return DTypeCastTransform(torch.uint8, torch.float32, in_keys=[keys.OBSERVATION])


@pytest.mark.parametrize("state", [False, True])
@pytest.mark.parametrize("board", [*presets.BOARDS, *LITERATURE])
def test_the_specs_are_kept(board, state):
    env = CommonsEnv(presets.game(board), worlds=3, state=state)
    check_env_specs(env)
    check_env_specs(env, seed=1)


@pytest.mark.parametrize("worlds", [1, 3])
def test_entries_have_the_shapes_and_types_of_the_house_and_each_spec_is_there_for_a_single_world(worlds):
    env = CommonsEnv(presets.game("commons"), worlds=worlds, state=True)
    assert env.group_map == {"agents": ["agent_0", "agent_1", "agent_2", "agent_3"]}
    assert env.n_agents == 4  # as TorchRL's own environments of several agents, which its tutorials ask
    assert env.full_action_spec[keys.ACTION].n == 8
    first = env.reset()
    after = env.step(env.rand_action(first.clone()))["next"]
    assert first[keys.AGENTS].batch_size == (worlds, 4)
    observation = env.observation_spec_unbatched
    for key, (shape, dtype) in EVERYTHING.items():
        for moment in (first, after):
            assert (moment[key].shape, moment[key].dtype) == ((worlds, *shape), dtype), key
        if key not in env.done_keys:
            assert (observation[key].shape, observation[key].dtype) == (shape, dtype), key
    assert (after[keys.REWARD].shape, after[keys.REWARD].dtype) == ((worlds, 4, 1), torch.float32)
    for kind in ("action", "observation", "reward", "done"):
        one, all_of_them = (getattr(env, f"full_{kind}_spec{end}") for end in ("_unbatched", ""))
        assert set(one.keys(True, True)) == set(all_of_them.keys(True, True))
        for key in one.keys(True, True):
            assert one[key].shape == all_of_them[key].shape[1:], key
        for values in (one.rand(), one.zero()):
            assert one.is_in(values), kind
            assert values.batch_size == ()
    assert observation.expand(worlds, *observation.shape) == env.observation_spec


def test_the_reward_is_the_harvest_and_changing_it_leaves_the_harvest_alone():
    env = CommonsEnv(SHORT, worlds=4)
    steps = env.rollout(9, break_when_any_done=False)["next"]
    assert torch.equal(steps[keys.REWARD][..., 0], steps[keys.HARVEST])
    assert steps[keys.HARVEST].sum() > 0
    harvest = steps[keys.HARVEST].clone()
    steps[keys.REWARD].mul_(-1)
    assert torch.equal(steps[keys.HARVEST], harvest)


@pytest.mark.parametrize("game", [SHORT, GOVERNED], ids=["plain", "institutions"])
def test_a_mask_resets_only_the_marked_worlds(game):
    env = CommonsEnv(game, worlds=3, seed=2)
    played = env.rollout(8)[:, -1]["next"].exclude(keys.REWARD)
    before = env.worlds.state()
    begun = env.reset(played.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    after = env.worlds.state()
    for key in begun.keys(True, True):
        if key != "_reset":
            assert torch.equal(begun[key][[0, 2]], played[key][[0, 2]]), key
    for name, array in after.items():
        assert np.array_equal(array[[0, 2]], before[name][[0, 2]]), name
    assert begun[keys.STOCK][1] == len(game.map.sites)
    assert after["step"][:, 0].tolist() == [8, 0, 8]
    assert after["episode"][:, 0].tolist() == [0, 1, 0]
    if game.institutions:
        for key in (keys.FINES, keys.TRANSFERS, keys.VIOLATED, keys.COUNTS):
            assert not begun[key][1].any(), key
        assert played[keys.COUNTS][1].any()


@pytest.mark.parametrize(
    "game",
    [SHORT, GOVERNED, *LITERATURE],
    ids=["plain", "institutions", "beams", "river"],
)
def test_the_lean_step_equals_torchrls_own_and_what_was_returned_never_changes_later(game):
    if isinstance(game, str):
        game = presets.game(game)
        game = replace(game, rules=replace(game.rules, episode_steps=4, random_end=None))
    lean, stock = (make_env(game, worlds=4, seed=2) for _ in range(2))
    assert type(lean)._step_and_maybe_reset is LeanStepEnv._step_and_maybe_reset
    torch.manual_seed(0)
    moment, other_moment = lean.reset(), stock.reset()
    returned, copies = [moment], [moment.clone()]
    for _ in range(60):
        chosen = lean.action_spec.rand()
        for entry in (moment, other_moment):
            entry.update(chosen.clone())
            entry[keys.AGENTS, "value"], entry["note"] = chosen[keys.ACTION].float(), torch.ones(4)
        now, moment = lean.step_and_maybe_reset(moment)
        other_now, other_moment = EnvBase._step_and_maybe_reset(stock, other_moment)
        ended = now["next", "done"]
        # Where only some worlds begin anew, TorchRL zeroes what a policy wrote there and writes anew.
        ignored = CHOSEN if ended.any() and not ended.all() else ()
        for one, other, left_out in ((now, other_now, ()), (moment, other_moment, ignored)):
            assert_close(one.exclude(*left_out), other.exclude(*left_out))
            assert set(one.keys(True, True)) == set(other.keys(True, True))
            returned.append(one)
            copies.append(one.clone())
    assert sum(int(entry["next", "done"].sum()) for entry in returned if "next" in entry) > 4
    for entry, copy in zip(returned, copies, strict=True):
        # What a policy chose is written into the carried entry by design.
        assert_close(entry.exclude(*CHOSEN, "next"), copy.exclude(*CHOSEN, "next"))
        if "next" in copy:
            assert_close(entry["next"], copy["next"])


def test_rollouts_collectors_and_a_world_alone_give_the_same_turns():
    rolled = CommonsEnv(SHORT, worlds=3, seed=1).rollout(30, ByWindow(), break_when_any_done=False)
    collector = Collector(
        CommonsEnv(SHORT, worlds=3, seed=1),
        ByWindow(),
        frames_per_batch=90,
        total_frames=90,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    (collected,) = list(collector)
    for key in rolled.keys(True, True):
        assert torch.equal(rolled[key], collected[key]), key
    assert rolled["next", "done"].any()
    one = CommonsEnv(SHORT, worlds=1, seed=1, first_world=2)
    assert_close(rolled[2:3], one.rollout(30, ByWindow(), break_when_any_done=False))


@pytest.mark.parametrize("game", [GOVERNED, RICH], ids=["rgb", "rich"])
def test_with_institutions_the_specs_are_kept_and_agents_are_paid(game):
    check_env_specs(CommonsEnv(game, 3, state=True))
    decided = CommonsEnv(game, 3).rollout(30, break_when_any_done=False)
    assert decided[keys.DECISION].shape == (3, 30, 3)
    assert decided["next", *keys.COUNTS].shape == (3, 30, 3, len(COUNT_NAMES))
    assert decided["next", keys.IN_FORCE].shape == (3, 30, 4)
    assert decided["next", *keys.FINES].any()
    shown = decided["next", *keys.HARVEST] - decided["next", *keys.FINES] + decided["next", *keys.TRANSFERS]
    torch.testing.assert_close(decided["next", *keys.REWARD].squeeze(-1), shown, atol=1e-5, rtol=1e-5)


def test_a_game_without_institutions_has_none_of_their_entries():
    steps = CommonsEnv(replace(GOVERNED, institutions=()), 2).rollout(3)
    names = {key if isinstance(key, str) else key[-1] for key in steps.keys(True, True)}
    assert not names & {"fines", "transfers", "violated", "counts", "decision", "in_force"}


def test_what_was_kept_is_restored_whole():
    assert_restorable(lambda: CommonsEnv(GOVERNED, 3, seed=4))
    assert_restorable(lambda: make_env(RICH, worlds=2, seed=4, transforms=[StepCounter()]))


def steps_of(env, turns, decisions):
    """What an environment returns for actions and decisions, turn by turn."""
    moment, steps = env.reset(), []
    for turn, decided in zip(turns, decisions, strict=True):
        moment[keys.ACTION], moment[keys.DECISION] = turn, decided
        step, moment = env.step_and_maybe_reset(moment)
        steps.append(step["next"].clone())
    return torch.stack(steps, -1)


# Forked, since the lambda of a test cannot be pickled; TorchRL warns that it makes one in this process too.
@pytest.mark.filterwarnings("ignore:A lambda function was passed", "ignore:.*fork:DeprecationWarning")
@VECTORS
def test_torchrls_vectors_of_envs_play_the_same(kind):
    turns = torch.as_tensor(random_actions(40, 6, GOVERNED)).view(40, 2, 3, 3)
    decisions = torch.as_tensor(random_decisions(40, 6, GOVERNED)).view(40, 2, 3, 3)
    vector = kind(2, [partial(CommonsEnv, GOVERNED, 3, seed=seed) for seed in (1, 2)])
    try:
        together = steps_of(vector, turns, decisions)
    finally:
        vector.close()
    for worker, seed in enumerate((1, 2)):
        alone = steps_of(CommonsEnv(GOVERNED, 3, seed=seed), turns[:, worker], decisions[:, worker])
        for key in alone.keys(True, True):
            assert torch.equal(alone[key], together[key][worker]), key


def regrown_by_worker(vec_env, seed=None, **options):
    """What grew in each of two environments, int64 [2, 200], when both are played by the same actions."""
    if seed is not None:
        vec_env.set_seed(seed, **options)
    try:
        moment, grown = vec_env.reset(), []
        for turn in torch.as_tensor(random_actions(200, 1, presets.game("commons"))):
            action = turn.expand(2, -1, -1).clone()
            _, moment = vec_env.step_and_maybe_reset(moment.set(keys.ACTION, action))
            grown.append(moment["regrown"].flatten())
        return torch.stack(grown, 1)
    finally:
        vec_env.close()


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:A lambda function was passed", "ignore:.*fork:DeprecationWarning")
@VECTORS
def test_workers_of_one_call_play_different_worlds(kind):
    def grown(*seed, **options):
        return regrown_by_worker(kind(2, lambda: CommonsEnv(presets.game("commons"))), *seed, **options)

    unasked, seeded = grown(), grown(5)
    assert unasked.sum(1).min() > 0
    assert not torch.equal(*unasked), "no seed was given, and both workers play the same worlds"
    assert not torch.equal(*seeded), "set_seed gave both workers the same worlds"
    assert torch.equal(seeded, grown(5))
    assert not torch.equal(seeded, grown(6))
    assert torch.equal(*grown(5, static_seed=True)), "asked for by static_seed"


def test_without_a_seed_torchs_generator_decides():
    def seed_of_a_new_one():
        return int(CommonsEnv(SHORT).worlds.now.seed[0, 0])

    torch.manual_seed(3)
    first, second = seed_of_a_new_one(), seed_of_a_new_one()
    torch.manual_seed(3)
    assert first != second
    assert seed_of_a_new_one() == first


def test_the_state_is_the_whole_board_in_colour():
    env = CommonsEnv(Game(map=maps.parse("A.#\n.>."), rules=Rules(may_fire=False)), state=True)
    state = env.reset()[keys.STATE][0].permute(1, 2, 0).tolist()
    assert state[0] == [[0, 255, 0], [10, 10, 10], [125, 125, 125]]
    assert state[1] == [[10, 10, 10], [255, 0, 0], [50, 50, 50]]


def test_devices_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match='device is "meta"; allowed: "cpu" and "cuda"'):
        CommonsEnv(SHORT, device="meta")
    with pytest.raises(ValueError, match="threads is 2; allowed: None on a GPU"):
        CommonsEnv(SHORT, device="cuda", threads=2)
    if not torch.cuda.is_available() and not runs_plain():
        with pytest.raises(ValueError, match='device is "cuda"; allowed: "cpu"'):
            CommonsEnv(SHORT, device="cuda")


def test_a_step_that_leaves_out_a_world_that_is_playing_is_refused():
    env = CommonsEnv(SHORT, worlds=2)
    moment = env.rand_action(env.reset())
    with pytest.raises(ValueError, match='"_step" leaves out world 1'):
        env.step(moment.clone().set("_step", torch.tensor([[True], [False]])))
    moment = env.step(moment.set("_step", torch.ones(2, 1, dtype=torch.bool)))["next"]
    assert moment["agents", "observation"].shape[0] == 2


def test_a_board_with_a_rim_of_walls_is_played_under_transforms():
    game = Game(map=maps.parse("#####\n#>AA#\n#####"), rules=Rules(window_rows=3, window_columns=3))
    env = make_env(game, worlds=2, transforms=[StepCounter()])
    steps = env.rollout(3)
    assert steps["next", "agents", "harvest"].sum() >= 0
    new = CommonsEnv(game, worlds=2)
    new.load(CommonsEnv(game, worlds=2).worlds.state())
    with pytest.raises(ValueError, match=r"have not begun; allowed: reset\(\) or load\(\)"):
        new.step(TensorDict({"agents": {"action": torch.zeros(2, 1, dtype=torch.int64)}}, [2]))


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")  # TorchRL's own
def test_transforms_that_learn_are_put_back_and_share_nothing():
    def made():
        transforms = [as_floats(), VecNormV2(in_keys=[keys.OBSERVATION])]
        return make_env(SHORT, worlds=2, transforms=transforms)

    assert_restorable(made)
    first, second = made(), made()
    first.rollout(3)
    load_transforms_state(second, transforms_state(first))
    before = deepcopy(transforms_state(first))
    second.rollout(9, break_when_any_done=False)
    assert str(transforms_state(first)) == str(before)
    assert str(transforms_state(second)) != str(before)


def test_a_transform_that_cannot_be_put_back_is_named():
    pool = TimeMaxPool(in_keys=[keys.OBSERVATION], T=2)
    with pytest.raises(ValueError, match=r"the transforms DTypeCastTransform, TimeMaxPool .*; allowed: "):
        make_env(SHORT, worlds=2, transforms=[as_floats(), pool])
