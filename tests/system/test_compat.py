"""Each private part of a library that cprl relies on is still there, and does what cprl wants of it.

A failure here names the part that an upgrade has changed, and the function of cprl that relies on it.
"""

import errno
import gc
import importlib
import inspect
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Annotated, NamedTuple

import numba
import numpy as np
import pytest
import rerun as rr
import torch
from cql import bootstrap_from_target
from filelock import FileLock
from tensordict import TensorDict
from torch import nn
from torchrl.data import Binary
from torchrl.envs import EnvBase
from torchrl.modules import QValueActor
from torchrl.objectives import DiscreteCQLLoss, DQNLoss, SoftUpdate, ValueEstimators

from cprl import CommonsEnv, Game, Rules, keys, maps
from cprl.algorithms import PPO, RolloutSettings
from cprl.institutions.arrays import slicer
from cprl.objectives.functional import FunctionalLoss, total, weights_of
from cprl.system import compat
from cprl.system.compat import recordings, tensordicts, torch_compile, torchrl
from cprl.system.jit import compiled, disk_cache
from cprl.system.libraries import fitting_versions, relying_on, require
from cprl.values.array_types import Float64

SOURCE = Path(compat.__file__).parents[2]
SHORT = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"), rules=Rules(window_rows=3, window_columns=5, episode_steps=9)
)


def test_every_part_of_compat_has_a_test_that_names_it():
    shown = {name for name in vars(compat) if not name.startswith("_")}
    modules = {path.stem for path in (SOURCE / "system" / "compat").glob("*.py")}
    named = set(re.findall(r"compat\.(\w+)", Path(__file__).read_text()))
    assert shown - modules - named == set()


def kept_here():
    with disk_cache.numba_cache_in(Path()):
        pass


TORCH, RERUN = r"torch \S+ has no torch\.", r"rerun-sdk \S+ has no rerun_bindings\."


@pytest.mark.parametrize(
    ("module", "part", "use", "message"),
    [
        ("torch._dynamo", "config", torch_compile.every_guard, TORCH + r"_dynamo\.config"),
        ("torch._inductor.loop_body", "LoopBody", torch_compile.sound_local_buffers, TORCH + r".*LoopBody"),
        (
            "torch._C._dynamo.eval_frame",
            "_debug_get_cache_entry_list",
            lambda: torch_compile.compiled_code(doubled),
            TORCH + r".*_debug_get_cache_entry_list",
        ),
        (
            "torch._dynamo.guards",
            "DeletedGuardManagerWrapper",
            lambda: torch_compile.guards_hold(doubled, ()),
            TORCH + r".*DeletedGuardManagerWrapper",
        ),
        (
            "torch._inductor.cpu_vec_isa",
            "VecISA",
            torch_compile.trusted_vector_instructions,
            TORCH + r"_inductor\.cpu_vec_isa",
        ),
        (
            "rerun_bindings",
            "flush_and_cleanup_orphaned_recordings",
            recordings.end_recordings,
            RERUN + "flush_and_cleanup_orphaned_recordings",
        ),
        ("numba.core.config", "CACHE_DIR", kept_here, r"numba\.config\.CACHE_DIR"),
    ],
    ids=lambda value: value if isinstance(value, str) and "." not in value else "",
)
def test_a_part_that_an_upgrade_took_away_is_named_where_it_is_used(module, part, use, message, monkeypatch):
    monkeypatch.delattr(importlib.import_module(module), part)
    with pytest.raises(ImportError, match=rf"{message}.*, on which cprl \S+ relies"):
        use()


def test_a_part_of_a_class_that_is_gone_is_named_when_cprl_is_imported():
    class LossModule:
        _has_gone = 1

    require("torchrl", LossModule, "_has_gone")
    with pytest.raises(ImportError, match=r"torchrl 0\.\S+ has no \S*LossModule\._reduce_loss, on which"):
        require("torchrl", LossModule, "_has_gone", "_reduce_loss")
    with pytest.raises(ImportError, match=r"has no LossModule\._has_update_associated"):
        torchrl.updated_weights(LossModule())


def test_the_versions_that_fit_are_those_of_the_package():
    assert fitting_versions("torchrl") == "<0.15,>=0.14.1"
    assert fitting_versions("no-such-library") == ""
    with (
        pytest.raises(ImportError, match=r"no-such-library \(not installed\) has no it, .*pyproject\.toml"),
        relying_on("no-such-library", "it"),
    ):
        raise AttributeError("it")


def test_entries_are_read_and_written_past_the_checks_of_tensordict():
    tensor, other = torch.arange(3), torch.ones(3)
    moment = TensorDict({"a": tensor}, [3])
    assert tensordicts.entry(moment, "a") is tensor
    views = tensordicts.Views(moment)
    assert views["a"] is views["a"]
    assert torch.equal(torch.from_numpy(views["a"]), tensor)
    for read in (views.__getitem__, lambda name: tensordicts.entry(moment, name)):
        with pytest.raises(KeyError):
            read("b")
    tensordicts.put(moment, "b", other)
    assert moment["b"] is other
    tensordicts.put(moment, "b", tensor)
    assert moment["b"] is tensor
    assert (keys.entry, keys.put) == (tensordicts.entry, tensordicts.put)


def test_tensordicts_are_made_and_filled_without_checks():
    entries, size = {"a": torch.arange(3)}, torch.Size([3])
    made = tensordicts.unchecked_tensordict(entries, size, torch.device("cpu"))
    assert made["a"] is entries["a"]
    assert (made.batch_size, made.device) == (size, torch.device("cpu"))
    assert tensordicts.unchecked_tensordict({}, size).device is None
    assert (made == TensorDict({"a": torch.arange(3)}, [3])).all()
    tensordicts.put_all(made, {"b": torch.ones(3), "c": torch.zeros(3)})
    assert set(made.keys()) == {"a", "b", "c"}
    assert made.clone()["b"].sum() == 3


def test_torchrl_steps_and_resets_by_the_method_of_the_environment(monkeypatch):
    env = CommonsEnv(SHORT, 2, seed=0)  # a torchrl.LeanStepEnv
    lean, stock = [], []
    of_env, of_torchrl = CommonsEnv.lean_step, EnvBase._step_and_maybe_reset
    monkeypatch.setattr(CommonsEnv, "lean_step", lambda *how: lean.append(1) or of_env(*how))
    monkeypatch.setattr(EnvBase, "_step_and_maybe_reset", lambda *how: stock.append(1) or of_torchrl(*how))
    env.step_and_maybe_reset(env.rand_action(env.reset()))
    assert (len(lean), len(stock)) == (1, 0), "step_and_maybe_reset does not call it"
    env.rollout(5, break_when_any_done=False)
    assert (len(lean), len(stock)) == (5, 0), "rollout does not call it in all steps but the last"
    moment = env.rand_action(env.reset())
    moment["next"] = env.fake_tensordict()["next"]
    env.step_and_maybe_reset(moment)
    assert (len(lean), len(stock)) == (5, 1), "a step into given tensors is TorchRL's own"


def test_specs_of_flags_can_be_indexed_by_a_group_of_agents_and_mean_what_binary_means():
    spec = torchrl.flag_spec(2, 3)
    assert Binary(3, shape=(2, 3), dtype=torch.bool) == spec
    assert spec[0, :].shape == (3,)
    assert spec.rand().dtype == spec.zero().dtype == torch.bool
    assert spec.is_in(torch.zeros(2, 3, dtype=torch.bool))


def transitions(count):
    following = {
        "observation": torch.rand(count, 2),
        "reward": torch.ones(count, 1),
        "done": torch.zeros(count, 1, dtype=torch.bool),
        "terminated": torch.zeros(count, 1, dtype=torch.bool),
    }
    return TensorDict(
        {
            "observation": torch.rand(count, 2),
            "action": torch.randint(3, (count,)),
            "next": TensorDict(following, (count,)),
        },
        (count,),
    )


def q_actor():
    return QValueActor(nn.Linear(2, 3), spec=None, action_space="categorical")


def q_loss(kind=DQNLoss):
    """Of an agent with values of three actions for what it sees, two numbers."""
    loss = kind(q_actor(), delay_value=True, action_space="categorical")
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.5)
    if kind is DiscreteCQLLoss:
        bootstrap_from_target(loss.value_estimator)
    return loss


def layer(weights):
    """Weight and bias of the one layer among a loss's weights."""
    flat = weights.flatten_keys(".")
    return [flat[f"module.0.module.{name}"].data for name in ("weight", "bias")]


def test_a_loss_does_not_warn_of_targets_that_are_promised():
    loss = q_loss()
    with pytest.warns(UserWarning, match="No target network updater"):
        loss(transitions(4))
    torchrl.promise_targets(loss)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(transitions(4))


def test_the_entropy_of_a_ppo_loss_is_vmapped_once_it_is_taken_by_its_formula():
    network, spaces = PPO(settings=RolloutSettings()), Game(map=maps.parse("A>"), rules=Rules()).spaces
    parts = network.make_network(spaces)
    seen = torch.rand(2, 3, *spaces.observation_shape)

    def entropy_of(loss):
        def of_lane(observation):
            policy = loss.actor_network.get_dist(TensorDict({"observation": observation}, [3]))
            return loss._get_entropy(policy, adv_shape=torch.Size([3]))

        return torch.vmap(of_lane)(seen)

    loss = network.make_loss(parts)
    with pytest.raises(RuntimeError, match="data-dependent control flow"):
        entropy_of(loss)
    torchrl.entropy_by_formula(loss)
    logits = parts["actor"](seen)
    expected = torch.distributions.Categorical(logits=logits).entropy().unsqueeze(-1)
    torch.testing.assert_close(entropy_of(loss), expected)


def test_a_loss_refuses_updaters_of_torchrl_by_the_names_of_its_targets():
    loss = q_loss()
    assert torchrl.updated_weights(loss) == []
    torchrl.promise_targets(loss)
    assert torchrl.updated_weights(loss) == ["value_network"]
    torchrl.refuse_updaters(loss, "cprl updates these targets")
    with pytest.raises(ValueError, match="cprl updates these targets"):
        SoftUpdate(loss, eps=0.9)


@pytest.mark.parametrize("kind", [DQNLoss, DiscreteCQLLoss])
def test_a_loss_computes_with_whatever_weights_are_put_in_now(kind):
    batch, losses, function = transitions(5), [q_loss(kind), q_loss(kind)], q_loss(kind)
    for loss in (*losses, function):
        torchrl.promise_targets(loss)
        loss.reduction = "none"
    wanted = [total(loss(batch.clone()), loss) for loss in losses]
    function, weights = FunctionalLoss(function), [weights_of(loss) for loss in losses]
    for turn in (0, 1, 0):  # torchrl.forget_cached_weights
        torch.testing.assert_close(function(weights[turn], batch.clone()), wanted[turn])


def test_conservative_q_learning_bootstraps_from_its_target():
    # loss = half the mean of (Q - (r + gamma max_a Q'(s', a)))^2, with r = 1 and gamma = 0.5
    loss, batch = q_loss(DiscreteCQLLoss), transitions(6)
    torchrl.promise_targets(loss)
    target = layer(loss.target_value_network_params)
    for weight in target:
        weight.mul_(-3)
    bootstrapped = nn.functional.linear(batch["next", "observation"], *target).amax(-1)
    values = nn.functional.linear(batch["observation"], *layer(loss.value_network_params))
    chosen = values.gather(-1, batch["action"][:, None]).squeeze(-1)
    by_hand = 0.5 * (chosen - (1 + 0.5 * bootstrapped)).square().mean()
    torch.testing.assert_close(loss(batch)["loss_qvalue"].detach(), by_hand)


class Squared(torchrl.ReshapedLoss, DQNLoss):
    """The squares of the losses of transitions."""

    def reshape_each(self, losses):
        return losses.square()


def test_losses_of_transitions_pass_through_a_function_before_they_are_reduced():
    batch, actor, found = transitions(6), q_actor(), {}
    for kind in (DQNLoss, Squared):
        for reduction in ("none", "mean"):
            loss = kind(actor, delay_value=True, action_space="categorical", reduction=reduction)
            loss.make_value_estimator(ValueEstimators.TD0, gamma=0.5)
            torchrl.promise_targets(loss)
            found[kind, reduction] = loss(batch)["loss"]
    torch.testing.assert_close(found[Squared, "none"], found[DQNLoss, "none"].square())
    torch.testing.assert_close(found[Squared, "mean"], found[DQNLoss, "none"].square().mean())


def doubled(values):
    return values * 2


# Of torch itself, while it compiles.
ignored = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def compiled_of_its_own(size):
    own = torch_compile.with_new_code(doubled)
    assert called_first(own, torch.ones(size)).tolist() == [2.0] * size
    return own


def called_first(own, *arguments):
    with torch_compile.every_guard():
        options = dict(torch_compile.COMPILE_OPTIONS)
        return torch.compile(own, fullgraph=True, dynamic=False, options=options)(*arguments)


@pytest.mark.integration
@ignored
def test_torch_hands_over_what_it_compiled_and_keeps_it_by_code_object():
    own, five = compiled_of_its_own(3), compiled_of_its_own(5)
    assert torch_compile.compiled_code(own) is not torch_compile.compiled_code(five)
    assert own.__code__ is not doubled.__code__
    code = torch_compile.compiled_code(own)
    assert code is not None
    direct = torch_compile.without_lookup(own, code)
    torch._dynamo.reset()  # as somebody else in the process may
    assert direct(torch.full((3,), 4.0)).tolist() == [8.0] * 3
    assert torch_compile.compiled_code(own) is None, "it is gone from the cache"


@pytest.mark.integration
@ignored
def test_torch_says_for_which_arguments_its_code_is_right():
    own = compiled_of_its_own(2)
    assert torch_compile.guards_hold(own, (torch.zeros(2),))
    assert not torch_compile.guards_hold(own, (torch.zeros(3),))
    assert not torch_compile.guards_hold(own, (torch.zeros(2, dtype=torch.int64),))
    torch._dynamo.reset()
    assert not torch_compile.guards_hold(own, (torch.zeros(2),)), "its guards are gone"


class Doubling:
    """What the class of an owner refers to."""

    factor = 2.0


def multiplied(owner, values):
    return values * owner.layer(values).factor


@pytest.mark.integration
@ignored
def test_code_that_depended_on_a_class_that_is_gone_fits_nothing():
    class Owner:
        @staticmethod
        def layer(values):
            return Doubling

    own = torch_compile.with_new_code(multiplied)
    arguments = Owner(), torch.ones(2)
    called_first(own, *arguments)
    assert torch_compile.guards_hold(own, arguments)
    del Owner, arguments
    gc.collect()
    assert not torch_compile.guards_hold(own, (Doubling(), torch.ones(2)))


def scaled(values):
    return values * Doubling.factor


@pytest.mark.integration
@ignored
def test_torch_leaves_guards_out_on_request(monkeypatch):
    options = {**torch_compile.COMPILE_OPTIONS, **torch_compile.NO_GUARDS}
    direct = torch.compile(
        torch_compile.with_new_code(scaled), fullgraph=True, dynamic=False, options=options
    )
    assert direct(torch.ones(2)).tolist() == [2.0, 2.0]
    monkeypatch.setattr(Doubling, "factor", 3.0)
    assert direct(torch.ones(2)).tolist() == [2.0, 2.0], "it no longer asks what it was made of"


@pytest.mark.integration
@ignored
def test_torch_guards_hooks_on_request():
    def applied(module, values):
        return module(values)

    own = torch_compile.with_new_code(applied)
    plain, hooked = (nn.Linear(2, 2).requires_grad_(False) for _ in range(2))
    hooked.register_forward_hook(lambda module, seen, given: given + 1)
    called_first(own, plain, torch.ones(2))
    assert torch_compile.guards_hold(own, (nn.Linear(2, 2).requires_grad_(False), torch.ones(2)))
    assert not torch_compile.guards_hold(own, (hooked, torch.ones(2)))


@pytest.mark.integration
@ignored
def test_torch_compiles_a_softmax_of_what_was_changed_in_place(tmp_path, monkeypatch):
    def masked(values):
        mask = torch.full((8, 8), -10000.0)
        mask[torch.arange(8).unsqueeze(0), torch.arange(8).unsqueeze(1)] = 0
        return torch.softmax(values + mask, dim=-1)

    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))  # what is in the cache is not compiled again
    values, own = torch.rand(8, 8), torch_compile.with_new_code(masked)
    with pytest.raises(torch._inductor.exc.InductorError, match="KeyError: 'buf1'"):
        called_first(own, values)
    torch._dynamo.reset()
    with torch_compile.sound_local_buffers():
        got = called_first(torch_compile.with_new_code(masked), values)
    torch.testing.assert_close(got, masked(values))


def summed(values):
    total = 0.0
    for value in values:
        total += value
    return total


def test_numba_refuses_allocations():
    def allocates(values):
        return (values + 1).sum()

    assert numba.njit(**compiled.CPU_OPTIONS)(summed)(np.ones(3)) == 3
    with pytest.raises(Exception, match="NRT"):
        numba.njit(**compiled.CPU_OPTIONS)(allocates)(np.ones(3))


def summed_column(columns):
    (values,) = columns
    so_far = 0.0
    for value in values:
        so_far += value
    return so_far


@pytest.mark.integration
def test_numba_gives_the_machine_code_of_a_function_unless_it_is_told_not_to_compile(tmp_path, monkeypatch):
    monkeypatch.setenv("CPRL_CACHE", str(tmp_path))
    monkeypatch.setenv(compiled.RULES_VARIABLE, compiled.COMPILED_RULES)
    code = compiled.machine_code(summed_column, (np.ones(3),))
    assert code((np.arange(5.0),)) == 10
    assert list(tmp_path.glob("rules/summed_column-*/key.py"))
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    plain = compiled.machine_code(summed_column, (np.ones(3),))
    assert "compiled.py" in plain.__code__.co_filename
    assert plain((np.arange(5.0),)) == 10


class Grown(NamedTuple):
    """Arrays of worlds within others."""

    by: Annotated[Float64, "B K"]


class Meadow(NamedTuple):
    """Records, with one that is missing and an array that has gaps."""

    apples: Annotated[Float64, "B K"]
    gains: Annotated[Float64, "K"]
    grown: Grown
    rain: Grown | None


one_meadow = slicer(Meadow)


def rained(rain, site):
    if rain is None:
        return 0.0
    return rain.by[site]


def grow(meadow, times):
    for site in range(meadow.apples.shape[0]):
        meadow.apples[site] += times * meadow.gains[site]
        meadow.grown.by[site] = times
        meadow.apples[site] += rained(meadow.rain, site)


def grown_meadow(meadow, again):
    for world in range(meadow.apples.shape[0]):
        one = one_meadow(meadow, world)
        grow(one, 2.0)
        for (other,) in (again,):
            grow(one_meadow(other, world), 1.0)
    return meadow.apples[0, 0]


rained.__module__ = grow.__module__ = "cprl.tests"  # whose functions are rules


@pytest.mark.integration
@pytest.mark.parametrize("rains", [pytest.param(False, marks=pytest.mark.integration), True])
def test_numba_takes_records_by_reference_and_rules_as_parts_of_one_piece(rains, tmp_path, monkeypatch):
    def meadow():
        gains = np.arange(12.0)[::4]  # with gaps
        rain = Grown(np.full((2, 3), 0.5)) if rains else None
        return Meadow(np.arange(6.0).reshape(2, 3), gains, Grown(np.zeros((2, 3))), rain)

    monkeypatch.setenv("CPRL_CACHE", str(tmp_path))
    monkeypatch.setenv(compiled.RULES_VARIABLE, compiled.COMPILED_RULES)
    plain, fast, other, same = (meadow() for _ in range(4))
    code = compiled.machine_code(grown_meadow, fast, (other,))
    assert grown_meadow(plain, (same,)) == code(fast, (other,))
    for made, wanted in ((fast, plain), (other, same)):
        np.testing.assert_array_equal(made.apples, wanted.apples)
        np.testing.assert_array_equal(made.grown.by, wanted.grown.by)


def test_numba_keeps_compiled_functions_where_it_is_told(tmp_path):
    before = numba.config.CACHE_DIR
    with disk_cache.numba_cache_in(tmp_path):
        function = numba.njit(cache=True)(summed)
    assert before == numba.config.CACHE_DIR
    assert function(np.ones(2)) == 2
    assert list(tmp_path.rglob("*.nbi")), "nothing was kept"


def test_numba_says_which_functions_it_keeps_for_which_arguments_and_a_damaged_file_is_none(tmp_path):
    with disk_cache.numba_cache_in(tmp_path):
        function = numba.njit(cache=True)(summed)
    floats, integers = (numba.typeof(np.ones(2)),), (numba.typeof(np.ones(2, np.int64)),)
    assert not disk_cache._is_cached(function, floats)
    function(np.ones(2))
    assert disk_cache._is_cached(function, floats)
    assert not disk_cache._is_cached(function, integers)
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(b"damaged")
    assert not disk_cache._is_cached(function, floats)


@pytest.fixture
def kept_summed(tmp_path):
    """A function that Numba keeps in a folder."""
    with disk_cache.numba_cache_in(tmp_path):
        return disk_cache.compile_with_disk_cache(summed)


def test_a_full_disk_leaves_compiled_functions_unkept_and_they_run(kept_summed, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    with pytest.warns(RuntimeWarning, match="No space left on device.*CPRL_CACHE"):
        assert kept_summed(np.ones(2)) == 2
    assert not list(tmp_path.rglob("*.nbi"))


def kept_anew(folder):
    """What a new process has of the function that Numba keeps in a folder."""
    with disk_cache.numba_cache_in(folder):
        return disk_cache.compile_with_disk_cache(summed)


def halved(content):
    return content[: len(content) // 2]


def flipped(content, place=0.6):
    """A file in which one bit is another."""
    index = int(len(content) * place)
    return content[:index] + bytes([content[index] ^ 4]) + content[index + 1 :]


DAMAGES = {
    "cut": halved,
    "empty": lambda _: b"",
    "garbage": lambda content: content[:40] + b"\xff" * 300,
    "zeros": lambda content: bytes(len(content)),
    "a flipped bit": flipped,
}


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_of_compiled_functions_is_named_once_and_made_anew(
    kept_summed, tmp_path, suffix, damage
):
    assert kept_summed(np.ones(2)) == 2
    [path] = tmp_path.rglob(f"*.{suffix}")
    sound = path.read_bytes()
    path.write_bytes(DAMAGES[damage](sound))
    with pytest.warns(RuntimeWarning, match="damaged") as warned:
        assert kept_anew(tmp_path)(np.ones(3)) == 3
    assert str(path) in str(warned.pop().message)
    assert len(warned) == 0
    assert len(path.read_bytes()) > 100
    healed = kept_anew(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert healed(np.ones(3)) == 3
    assert sum(healed.stats.cache_hits.values()) == 1


def test_a_flipped_bit_of_machine_code_is_seen_wherever_it_is(kept_summed, tmp_path):
    kept_summed(np.ones(2))
    [path] = tmp_path.rglob("*.nbc")
    assert disk_cache._is_intact(path)
    sound = path.read_bytes()
    for place in np.linspace(0, 1, 24, endpoint=False):
        path.write_bytes(flipped(sound, place))
        assert not disk_cache._is_intact(path), place


def test_a_damaged_file_that_cannot_be_removed_is_not_read(kept_summed, tmp_path, monkeypatch):
    kept_summed(np.ones(2))
    [path] = tmp_path.rglob("*.nbc")
    path.write_bytes(flipped(path.read_bytes()))

    def refuse(path, **_):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    function = kept_anew(tmp_path)
    with pytest.warns(RuntimeWarning, match="Read-only file system.*CPRL_CACHE"):
        assert function(np.ones(3)) == 3
    assert not function.stats.cache_hits


def test_a_process_that_never_ends_to_compile_is_waited_for_no_longer_than_some_time(
    kept_summed, monkeypatch
):
    monkeypatch.setattr(disk_cache, "_WAIT_S", 0.05)
    with FileLock(Path(kept_summed.stats.cache_path) / "summed.lock"):
        assert kept_summed(np.ones(2)) == 2


COMPILES_IN_STEP = """
import sys, time
from pathlib import Path
from typing import Annotated, NamedTuple
import numpy as np
from cprl.system.jit import disk_cache

def doubled(values):
    return values * 2

folder = Path(sys.argv[1])
with disk_cache.numba_cache_in(folder / "cache"):
    function = disk_cache.compile_with_disk_cache(doubled)
(folder / f"ready-{sys.argv[2]}").touch()
while len(list(folder.glob("ready-*"))) < 3:
    time.sleep(0.001)
function(np.ones(2))
print(sum(function.stats.cache_misses.values()))
"""


@pytest.mark.integration
def test_of_processes_that_start_together_one_compiles_and_the_others_read(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(COMPILES_IN_STEP)
    started = [
        subprocess.Popen([sys.executable, script, tmp_path, str(number)], stdout=subprocess.PIPE, text=True)
        for number in range(3)
    ]
    assert sorted(process.communicate(timeout=100)[0].strip() for process in started) == ["0", "0", "1"]


LIBRARY_PARTS = (
    r"\b(?!self\b|cls\b|super\(\))[\w\])]+\._(?:get_str|set_str|new_unsafe|tensordict|modules|parameters|buffers)\b",
    r"_has_update_associated",
    r"_step_and_maybe_reset\(",
    r"\btorch\._\w+",
    r"\b(?:torchrl|tensordict|numba|rerun)(?:\.\w+)*\._\w+",
    r"_debug_get_cache_entry_list",
    r"skip_all_guards_unsafe",
    r"_log_to_stream",
    r"\"_nrt\"",
)


def test_private_parts_of_libraries_are_used_in_their_home_alone():
    homes = {path for package in ("compat", "jit") for path in (SOURCE / "system" / package).glob("*.py")}
    assert len(homes) > 8
    found = [
        f"{path.relative_to(SOURCE)}:{number}: {line.strip()}"
        for path in sorted(SOURCE.rglob("*.py"))
        if path not in homes
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if any(re.search(part, line) for part in LIBRARY_PARTS)
    ]
    assert found == [], "move these into cprl.system.compat, with a test here"


def test_a_policy_that_is_nan_changes_nothing_of_the_others():
    """Without it TorchRL samples all entropies where one is NaN, and torch refuses to sample from NaN."""
    sound = torch.tensor([[0.5, -1.0, 2.0], [0.0, 0.1, 0.2]])
    whole, usual = torchrl.LaneCategorical(logits=sound), torch.distributions.Categorical(logits=sound)
    broken = torchrl.LaneCategorical(logits=torch.cat([sound, torch.full((1, 3), torch.nan)]))
    assert torch.equal(whole.entropy(), usual.entropy())
    assert torch.equal(broken.entropy()[:2], usual.entropy())
    assert broken.entropy()[2] == 0
    drawn = []
    for own in (whole, usual):
        torch.manual_seed(3)
        drawn.append(own.sample((50,)))
    assert torch.equal(*drawn)
    assert broken.sample((50,)).shape == (50, 3)
    action = torch.tensor([0, 1, 2])
    assert torch.equal(broken.log_prob(action)[:2], usual.log_prob(action[:2]))
    assert broken.log_prob(action)[2].isnan()
    with pytest.raises(RuntimeError, match="contains either `inf`, `nan`"):
        torch.distributions.Categorical(logits=torch.full((1, 3), torch.nan)).sample()


_RECORDINGS = """
import os, sys
from pathlib import Path
from typing import Annotated, NamedTuple
import rerun as rr
from cprl.system.compat.recordings import end_recordings
from cprl.viewer.logger import RerunLogger

folder = Path(sys.argv[1])

def threads():
    return len(os.listdir("/proc/self/task"))

def record(name):
    recording = rr.RecordingStream("cprl", recording_id=name)
    recording.save(folder / f"{name}.rrd")
    recording.disconnect()

record("first")
end_recordings()
before = threads()
record("second")
assert threads() > before, "Rerun keeps the threads of a recording that was dropped"
end_recordings()
assert threads() <= before
left = []
for number in range(4):
    RerunLogger("run", folder, file_name=f"{number}.rrd").close()
    left.append(threads())
# Rerun 0.41 never ends the recording into which it writes a blueprint; none left would be better.
assert left[-1] - left[0] <= 2 * 3, left
"""


def test_torch_is_quiet_about_operations_that_its_code_calls_by_the_dispatcher(caplog):
    from torch._inductor import ir

    assert '"%s is missing a c-shim implementation' in inspect.getsource(ir)
    with torch_compile.quiet_about_fallbacks():
        ir.log.warning("%s is missing a c-shim implementation", "aten.multinomial")
        ir.log.warning("something else")
    assert caplog.messages == ["something else"]
    ir.log.warning("%s is missing a c-shim implementation", "aten.multinomial")
    assert len(caplog.messages) == 2


@pytest.mark.slow
def test_recordings_that_nothing_refers_to_end_and_a_closed_logger_leaves_its_layouts_alone(tmp_path):
    command = [sys.executable, "-c", _RECORDINGS, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_vector_instructions_of_the_cpu_are_used_without_compiling(tmp_path, monkeypatch):
    from torch._inductor import cpu_vec_isa

    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(cpu_vec_isa, "x86_isa_checker", lambda: ["avx2", "avx512", "amx_tile"])
    kinds = [type(kind)() for kind in cpu_vec_isa.supported_vec_isa_list]  # torch remembers an answer
    monkeypatch.setattr(cpu_vec_isa, "supported_vec_isa_list", kinds)
    with torch_compile.trusted_vector_instructions():
        usable = cpu_vec_isa.valid_vec_isa_list.__wrapped__()
    assert [str(kind) for kind in usable] == ["avx512", "avx2"]
    assert list(tmp_path.iterdir()) == []


def test_the_layout_of_a_stored_recording_is_taken_over_by_another_one(tmp_path, monkeypatch):
    import rerun.blueprint as rrb
    from rerun.chunk import RrdReader

    def stored(name, layout):
        """The chunks of a recording's layout, and the values of its entities."""
        recording = rr.RecordingStream("cprl", recording_id=name)
        recording.save(tmp_path / name, default_blueprint=layout)
        recording.disconnect()
        reader = RrdReader(tmp_path / name)
        (store,) = reader.blueprints()
        batches = {chunk.entity_path: chunk.to_record_batch() for chunk in reader.stream(store=store)}
        values = {
            (entity, part): batch[part].to_pylist()
            for entity, batch in batches.items()
            for part in batch.schema.names
            if ":" in part
        }
        return reader.stream(store=store), values

    view = rrb.TimeSeriesView(name="Harvest", origin="/harvest")
    chunks, first = stored("first", rrb.Blueprint(view, collapse_panels=True))
    assert [["Harvest"]] in first.values()
    assert stored("second", recordings.StoredLayout(chunks))[1] == first
    monkeypatch.delattr(rrb.Blueprint, "_log_to_stream")
    with pytest.raises(ImportError, match=r"rerun-sdk \S+ has no Blueprint\._log_to_stream, on which cprl"):
        recordings.StoredLayout(chunks)


def test_what_ends_a_recording_waits_for_its_viewer_and_is_in_a_private_part():
    """`RecordingStream.__del__` flushes; `keep_native` keeps `inner` alive in its place."""
    recording = rr.RecordingStream("cprl", recording_id="kept")
    native = recording.inner
    before = sys.getrefcount(native)
    recordings.keep_native(recording)
    assert sys.getrefcount(native) == before + 1
    assert callable(vars(rr.RecordingStream)["__del__"])
    recording.disconnect()
