"""Code that relies on private parts of torch, TorchRL, tensordict or Rerun, or works around their bugs.

There is one function, class or constant for each, with a test in `tests/test_compat.py` that shows what an
upgrade has broken. The rest of cprl uses public interfaces. Two exceptions are elsewhere:

- code that relies on Numba is in `cprl.commons.compiled`, because the game works without torch;
- methods with an underscore that a library expects its subclasses to define (`EnvBase._reset`, `_step` and
  `_set_seed`, `Storage._empty`, `Sampler._empty`, `Logger._create_experiment`) are its interface for that.
"""

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Final
from unittest.mock import patch

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.base import NO_DEFAULT
from torchrl.data import Categorical
from torchrl.envs import EnvBase
from torchrl.objectives import HardUpdate, LossModule
from torchrl.objectives.value import ValueEstimatorBase

# ---- tensordict


def entry(tensordict: TensorDictBase, name: str) -> Any:
    """`tensordict.get(name)` without its handling of nested keys; takes a tenth of the time.

    Raises:
        KeyError: if there is no such entry.
    """
    return tensordict._get_str(name, NO_DEFAULT)


def put(tensordict: TensorDictBase, name: str, value: Any) -> None:
    """`tensordict.set(name, value)` without key handling or checks; the value must fit."""
    tensordict._set_str(name, value, validated=True, inplace=False, non_blocking=False)


def unchecked_tensordict(
    entries: dict[str, Any], batch_size: torch.Size, device: torch.device | None = None
) -> TensorDict:
    """`TensorDict(entries, batch_size, device=device)` without checks; the entries must fit, uncopied."""
    return TensorDict._new_unsafe(entries, batch_size=batch_size, device=device)


def put_all(tensordict: TensorDict, entries: Mapping[str, Any]) -> None:
    """`put` for several entries of a TensorDict of `unchecked_tensordict` at once."""
    tensordict._tensordict.update(entries)


# ---- TorchRL: environments and specs


class LeanStepEnv(EnvBase):
    """An `EnvBase` that steps and resets in its own method, `lean_step`.

    `EnvBase.step_and_maybe_reset`, rollouts and collectors call the private `_step_and_maybe_reset`, whose
    key handling takes seven times as long as a step of one world. This class overrides it.
    """

    @abstractmethod
    def lean_step(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Like `EnvBase.step_and_maybe_reset`, for all worlds."""

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        if not isinstance(tensordict, TensorDictBase):
            raise ValueError(f"tensordict is a {type(tensordict).__name__}; allowed: a TensorDict")
        if "next" in tensordict or "_step" in tensordict:  # a step of some worlds, or into given tensors
            return super()._step_and_maybe_reset(tensordict)  # type: ignore[no-any-return]
        return self.lean_step(tensordict)


def flag_spec(*shape: int) -> Categorical:
    """The spec of bools with a shape [B, ...], or [B, N, ...] in a group of agents.

    `Binary` describes the same values but treats its last axis as one vector: a spec [B, N] cannot be indexed
    in a group of shape [B, N], so `EnvBase.observation_spec_unbatched` raises an IndexError.
    """
    return Categorical(2, shape=shape, dtype=torch.bool)


# ---- TorchRL: losses


class LaneCategorical(torch.distributions.Categorical):
    """`Categorical` for the policies of several agents in one batch, of which one may be NaN.

    TorchRL's PPO losses replace the entropies of the whole batch by samples if one of them is not finite, and
    torch refuses to sample from NaN, on a GPU for the rest of the process. Here NaN has entropy 0 and is
    sampled uniformly; the log-probabilities, and so that agent's loss, stay NaN. Nothing else differs.
    """

    def entropy(self) -> torch.Tensor:
        """As of `Categorical`, and 0 for NaN."""
        entropy: torch.Tensor = super().entropy()  # type: ignore[no-untyped-call]
        # Compiled losses take a sample, made below, where the entropy is NaN.
        return entropy if torch.compiler.is_compiling() else entropy.nan_to_num(nan=0.0)

    def sample(self, sample_shape: Any = ()) -> torch.Tensor:
        """As of `Categorical`, and uniform for NaN."""
        size = torch.Size(sample_shape)
        weights = self.probs.reshape(-1, self._num_events).nan_to_num(nan=1.0)
        return torch.multinomial(weights, size.numel(), True).T.reshape(self._extended_shape(size))


class ReshapedLoss:
    """Of a `LossModule` whose losses of single transitions pass through a function before they are weighed
    and reduced; stands before the loss among the bases.

    TorchRL's losses know their distances by name, see `torchrl.objectives.utils.distance_loss`, and hand what
    those give to the private `LossModule._reduce_loss`, which this class overrides. The loss must call it
    once. This is no `LossModule` itself: the class of one has a `forward`, which would hide that of the loss.
    """

    def reshape_each(self, losses: torch.Tensor) -> torch.Tensor:
        """The function, of any shape."""
        raise NotImplementedError

    def _reduce_loss(self, loss: torch.Tensor, **how: Any) -> Any:
        return super()._reduce_loss(self.reshape_each(loss), **how)  # type: ignore[misc]


def updated_weights(loss: LossModule) -> list[str]:
    """The names of the weights whose targets a TorchRL target updater updates."""
    return [name for name, is_updated in loss._has_update_associated.items() if is_updated]


def refuse_updaters(loss: LossModule, message: str) -> None:
    """Makes a loss refuse TorchRL's target updaters, which read the names of its targets first."""
    loss._has_update_associated = _Refusing(loss._has_update_associated, message)


class _Refusing(dict[str, bool]):
    """One class for all losses: compiled code is shared only between learners of the same classes."""

    def __init__(self, names: Mapping[str, bool], message: str) -> None:
        super().__init__(names)
        self._message = message

    def keys(self) -> Any:
        raise ValueError(self._message)


def promise_targets(loss: LossModule) -> None:
    """Marks the targets of a loss as updated: it would warn that they have no TorchRL updater, while
    `Engine.copy_to_targets` updates them."""
    for name in loss._has_update_associated:
        loss._has_update_associated[name] = True


def forget_cached_weights(loss: LossModule) -> None:
    """Clears the detached weights that some losses cache at a call, so that they can be replaced."""
    loss.__dict__.pop("_cache", None)


def hard_update(loss: LossModule, *, every: int) -> HardUpdate:
    """A `HardUpdate` that copies to targets at every `every`-th call of `step`, at least 1.

    TorchRL counts one call more: with an interval of 2 it copies at every third call.
    """
    return HardUpdate(loss, value_network_update_interval=every - 1)


def bootstrap_from_target(estimator: ValueEstimatorBase) -> None:
    """Makes the estimator of a `DiscreteCQLLoss` bootstrap from the target network.

    The loss passes the target weights as `params`, but its estimator ignores them and would bootstrap from
    the network itself.
    """
    estimate = estimator.value_estimate

    def by_target(tensordict: TensorDictBase, *, params: TensorDictBase) -> torch.Tensor:
        target: torch.Tensor = estimate(tensordict, target_params=params)
        return target

    estimator.value_estimate = by_target


# ---- torch.compile

COMPILE_OPTIONS: Final[Mapping[str, Any]] = {"cpp_wrapper": True}
"""Options of `torch.compile`."""

NO_GUARDS: Final[Mapping[str, Any]] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
"""Further ones, for functions whose guards torch itself finds broken; `fits` must not be asked then."""


def every_guard() -> AbstractContextManager[Any]:
    """While it is open, torch guards what it compiles also against hooks of modules and shared parameters,
    which it leaves out because they take time at each call; `fits` is asked once for each learner."""
    import torch._dynamo  # takes a second

    patched: AbstractContextManager[Any] = torch._dynamo.config.patch(
        skip_nnmodule_hook_guards=False, skip_no_tensor_aliasing_guards_on_parameters=False
    )
    return patched


def sound_local_buffers() -> AbstractContextManager[Any]:
    """While it is open, torch's C++ code keeps what an operation changes in place out of the buffers of fused
    loops. Torch 2.13 asks for reads of it by a name that nobody reads, and fails with a KeyError; the open
    issue pytorch/pytorch#196570 says more. IPPO with five teams of four on `commons` meets it."""
    from torch._inductor.loop_body import LoopBody  # takes a second

    find: Any = LoopBody.get_read_expr

    def read_of(body: Any, buffer_name: str) -> Any:
        """The index of a read; None, which equals no index, where there is none."""
        with suppress(KeyError):
            return find(body, buffer_name)
        return None

    return patch.object(LoopBody, "get_read_expr", read_of)


def with_own_code(function: Any) -> FunctionType:
    """The same function with its own code object: torch caches compiled code by code object, and would
    treat learners of another size as a change of shapes."""
    code = function.__code__.replace(co_name=f"{function.__name__}_of_its_own")
    return FunctionType(code, function.__globals__, code.co_name)


def compiled_code(function: FunctionType) -> CodeType | None:
    """The code that torch compiled last for a function from `with_own_code`; None if there is none."""
    from torch._C._dynamo.eval_frame import _debug_get_cache_entry_list

    entries = _debug_get_cache_entry_list(function.__code__)
    return entries[-1].code if entries else None


def fits(function: FunctionType, arguments: Sequence[Any]) -> bool:
    """Whether all of torch's guards of `compiled_code` hold for arguments, which torch asks at each call.

    Guards are everything about the arguments, and about what can be reached from them, that the code takes
    for granted: types, functions, the numbers and texts that are constants in it, and the forms of tensors,
    whose values never are.
    """
    from torch._C._dynamo.eval_frame import _debug_get_cache_entry_list
    from torch._dynamo.guards import DeletedGuardManagerWrapper

    entries = _debug_get_cache_entry_list(function.__code__)
    guards = entries[-1].guard_manager if entries else None
    # Those of code that depended on an object that is gone hold for everything.
    if guards is None or isinstance(guards, DeletedGuardManagerWrapper):
        return False
    return bool(guards.check(dict(zip(function.__code__.co_varnames, arguments, strict=False))))


def without_lookup(function: FunctionType, code: CodeType) -> FunctionType:
    """The code that torch compiled for a function, to be called directly.

    Torch's lookup of it at every call takes half of the overhead of a call, and the guards a quarter of an
    update of 16 agents. Without them the caller must compile again when the form of arguments changes, as
    `cprl.compiling` does. The globals are a copy, because torch stores names in them that it may delete.

    Args:
        function: from `with_own_code`.
        code: from `compiled_code`.
    """
    return FunctionType(code, dict(function.__globals__), function.__name__)


@cache
def remember_vector_instructions() -> None:
    """Makes torch find out only once, not in every process, which vector instructions its compiler can use.

    It does so by loading a library in a new process for each set of instructions, which takes two seconds.
    The answer is kept in torch's cache folder, for this version of torch, compiler and CPU, if every set
    that the CPU has can be used.
    """
    from torch._inductor import cpu_vec_isa  # takes a second
    from torch._inductor.cpp_builder import get_compiler_version_info, get_cpp_compiler
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    find, every = cpu_vec_isa.valid_vec_isa_list, cpu_vec_isa.supported_vec_isa_list

    @cache
    def remembered() -> list[Any]:
        has = cpu_vec_isa.x86_isa_checker()
        usable = [kind for kind in every if has and all(flag in has for flag in str(kind).split())]
        text = f"{torch.__version__} {get_compiler_version_info(get_cpp_compiler())} {has}"
        mark = Path(cache_dir()) / f"usable_vectors_{sha256(text.encode()).hexdigest()[:16]}"
        if usable and mark.exists():
            return usable
        found: list[Any] = find()
        if usable and found == usable:
            with suppress(OSError):
                mark.touch()
        return found

    cpu_vec_isa.valid_vec_isa_list = remembered


# ---- Rerun


def end_recordings() -> None:
    """Flushes and ends recordings to which nothing refers any more: until then Rerun keeps two threads and
    the buffers of each. `rerun.init` does the same, but makes another recording."""
    from rerun_bindings import flush_and_cleanup_orphaned_recordings

    flush_and_cleanup_orphaned_recordings()


def send_chunk(
    recording: Any, entity: str, timelines: Mapping[str, Any], components: Mapping[Any, Any]
) -> None:
    """`RecordingStream.send_columns` without its checks and conversions, which take most of its time where a
    row is sent: `pyarrow` arrays of equal length by timeline and by component descriptor, without timelines a
    static row."""
    from rerun_bindings import send_arrow_chunk

    send_arrow_chunk(
        entity, timelines=dict(timelines), components=dict(components), recording=recording.to_native()
    )


def rows_made(entity: str, components: Mapping[Any, Any]) -> list[Any]:
    """The rows of `pyarrow` arrays of equal length, by component descriptor, as static chunks for
    `send_made`."""
    from rerun_bindings import ChunkInternal

    count = len(next(iter(components.values())))
    return [
        ChunkInternal.from_columns(entity, {}, {kind: own.slice(row, 1) for kind, own in components.items()})
        for row in range(count)
    ]


def send_made(recording: Any, made: Any) -> None:
    """Sends a chunk that has been made before, in a fifth of the time of `send_chunk` on cold caches."""
    from rerun_bindings import send_chunks

    send_chunks(made, recording.to_native())


def keep_native(recording: Any, keep: Callable[..., object] = ctypes.pythonapi.Py_IncRef) -> None:
    """In place of a recording's end, which waits for a viewer: its native part, the private `inner`, stays
    until the process ends.

    Args:
        recording: a `rerun.RecordingStream`, as its `__del__` gets it.
        keep: bound here, because the interpreter clears modules before it deletes the last recordings.
    """
    keep(ctypes.py_object(recording.inner))
