"""Compiled: a function compiled by torch, called without guards while shapes and dtypes stay the same.

Compiled code is kept for the process: another learner of the same form calls it too, if torch's guards hold
for its arguments. Weights, moments, buffers and what a loss keeps in tensors are read from the arguments at
each call; whatever else the code depends on is guarded, so a learner that differs in it gets code of its own.
"""

import gc
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from types import CodeType, FunctionType
from typing import Any, Final, NamedTuple

import torch

from cprl.system.compat import (
    COMPILE_OPTIONS,
    NO_GUARDS,
    compiled_code,
    every_guard,
    fits,
    quiet_about_fallbacks,
    remember_vector_instructions,
    sound_local_buffers,
    with_own_code,
    without_lookup,
)
from cprl.system.times import CLOCK

TOLERANCE: Final = 1e-4
"""The tolerance between float32 results of the same operations in another order."""

MOST_SHARED: Final = 16
"""Compiled forms of one function that are kept for other learners; of more, the oldest is dropped."""


_TO_MODULE_CURE: Final = (
    "; if a loss of your own writes `with params.to_module(network):`, write "
    "`params.to_module(network, preserve_module_state=False)` (docs/algorithms.md)"
)
"""Tensordict makes a new parameter by default, which torch does not compile."""


class _Shared(NamedTuple):
    form: Hashable
    guarded: Any
    """By whose code torch finds its guards."""
    direct: Any
    """The compiled code, called directly."""


_shared: Final[dict[CodeType, list[_Shared]]] = {}
"""By the code of the plain function; the oldest first."""


class Compiled:
    """A function of tensors, compiled at its first call and again when the form of its arguments changes.

    The form comprises everything but the values of tensors. At the first call with a form the function also
    runs uncompiled, on copies, and the results are compared. If compilation fails or the results differ, it
    warns once and runs uncompiled from then on. Functions that draw random numbers are not compared, because
    compiled code may draw different ones.

    Args:
        function: a plain function; values other than tensors are constants from the first call on.
        what: who acts, for warnings, which continue with "uncompiled", e.g. "agents act".
        changes: the positions of the arguments that it changes in place, tensors or lists of tensors.
        enabled: whether it is compiled.
    """

    def __init__(
        self, function: Callable[..., Any], *, what: str, changes: Sequence[int] = (), enabled: bool = True
    ) -> None:
        self._plain: Any = function
        self._what, self.enabled = what, enabled
        self._changes = tuple(changes)
        self._compiled: Callable[..., Any] | None = None
        self._form: Hashable = None

    def __call__(self, form: Hashable, *arguments: Any) -> Any:
        """Calls the function.

        Args:
            form: all that may change about the arguments except tensor values: shapes, dtypes, numbers.
        """
        if not self.enabled:
            return self._plain(*arguments)
        if self._compiled is not None and form == self._form:
            return self._compiled(*arguments)
        self._form = form
        with CLOCK.running("what agents learn by (about half a minute, once)"):
            return self._compile_and_call(*arguments)

    def _compile_and_call(self, *arguments: Any) -> Any:
        """The first call with a form; if compilation fails, no argument has been changed yet."""
        before = self._copies(arguments)
        reference = self._outcome(before)
        for shared in _fitting(self._plain, self._form, arguments):
            self._compiled = shared.direct
            result = self._compiled(*arguments)
            if self._difference(result, arguments, before, reference) is None:
                return result
            self._put_back(arguments, [before[place] for place in self._changes])
        copy = with_own_code(self._plain)
        try:
            result, is_guarded = self._first_call(copy, arguments)
        except Exception as error:
            self.enabled = False
            cure = _TO_MODULE_CURE if "torch.nn.Parameter()" in str(error) else ""
            warnings.warn(
                f"torch.compile failed, {self._what} uncompiled and several times slower{cure}: {error}",
                RuntimeWarning,
                stacklevel=4,
            )
            return self._plain(*arguments)
        set_aside()
        difference = self._difference(result, arguments, before, reference)
        if difference is None:
            if (code := compiled_code(copy)) is not None:
                self._compiled = without_lookup(copy, code)
                if is_guarded:
                    _share(self._plain, _Shared(self._form, copy, self._compiled))
            return result
        self.enabled = False
        warnings.warn(
            f"the results of compiled code differ by up to {difference:.3g} from uncompiled code, "
            f"{self._what} uncompiled and several times slower",
            RuntimeWarning,
            stacklevel=4,
        )
        self._put_back(arguments, reference[1:])
        return reference[0]

    def _first_call(self, function: FunctionType, arguments: Sequence[Any]) -> tuple[Any, bool]:
        """Compiles and calls; the result, and whether torch can tell which arguments the code fits."""
        remember_vector_instructions()
        for further in ({}, NO_GUARDS):
            options = {**COMPILE_OPTIONS, **further}  # a copy, because torch removes entries
            # Sizes and numbers of other learners, which torch remembers, must not make those of this one
            # variables of its code: not dynamic.
            self._compiled = torch.compile(function, fullgraph=True, dynamic=False, options=options)
            try:
                with warnings.catch_warnings(), every_guard(), sound_local_buffers(), quiet_about_fallbacks():
                    for kind in (DeprecationWarning, FutureWarning):  # raised inside torch and TorchRL
                        warnings.simplefilter("ignore", kind)
                    return self._compiled(*arguments), not further
            except Exception as error:
                if further or "Guard failed on the same frame" not in str(error):
                    raise
        raise AssertionError("unreachable")

    def _difference(
        self, result: Any, arguments: Sequence[Any], before: Sequence[Any], reference: Sequence[Any]
    ) -> float | None:
        """By how much a call differs from the plain function; None if they agree or it draws numbers."""
        outcome = [result, *(arguments[place] for place in self._changes)]
        difference = largest_difference(outcome, reference)
        return None if difference is None or self._is_random(before) else difference

    def _put_back(self, arguments: Sequence[Any], values: Sequence[Any]) -> None:
        for place, right in zip(self._changes, values, strict=True):
            for tensor, value in zip(tensors_in(arguments[place]), tensors_in(right), strict=True):
                tensor.copy_(value)

    def _copies(self, arguments: Sequence[Any]) -> list[Any]:
        return [copied(value) if place in self._changes else value for place, value in enumerate(arguments)]

    def _outcome(self, arguments: Sequence[Any], *, seed: int | None = None) -> list[Any]:
        """The result of the plain function, and the changed arguments as copies; the arguments and torch's
        generators are left unchanged."""
        copies = self._copies(arguments)
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            if seed is not None:
                torch.manual_seed(seed)
            result = self._plain(*copies)
        return [result, *(copies[place] for place in self._changes)]

    def _is_random(self, arguments: Sequence[Any]) -> bool:
        first, second = (self._outcome(arguments, seed=seed) for seed in (1, 2))
        return largest_difference(first, second) is not None


def _fitting(plain: FunctionType, form: Hashable, arguments: Sequence[Any]) -> Iterator[_Shared]:
    for shared in list(_shared.get(plain.__code__, ())):
        if shared.form == form and fits(shared.guarded, arguments):
            yield shared


def _share(plain: FunctionType, compiled: _Shared) -> None:
    newest = _shared.setdefault(plain.__code__, [])
    newest.append(compiled)
    del newest[:-MOST_SHARED]


def copied(value: Any) -> Any:
    return [copied(tensor) for tensor in value] if isinstance(value, list) else value.clone()


def tensors_in(value: Any) -> list[torch.Tensor]:
    return [tensor for part in value for tensor in tensors_in(part)] if isinstance(value, list) else [value]


def largest_difference(results: Sequence[Any], reference: Sequence[Any]) -> float | None:
    """The largest difference between tensors that do not agree; None if all agree.

    Numbers agree within `TOLERANCE`, or a thousandth of the largest number of their tensor if that is less.
    One number in a hundred of a tensor, and at least one of more than ten, may differ more: the first updates
    of Adam and RMSprop turn a gradient that is only rounding error into a full step.
    """
    pairs = list(zip(tensors_in(list(results)), tensors_in(list(reference)), strict=True))
    if all(_agree(*pair) for pair in pairs):
        return None
    return max(float((one.double() - other.double()).abs().max()) for one, other in pairs if one.numel())


def _agree(result: torch.Tensor, reference: torch.Tensor) -> bool:
    size = reference.numel()
    if not size:
        return True
    scale = float(reference.double().abs().max()) if reference.isfinite().all() else 1.0
    near = min(TOLERANCE, 10 * TOLERANCE * scale) + 1e-8
    off = ~torch.isclose(result.double(), reference.double(), TOLERANCE, near, equal_nan=True)
    return int(off.sum()) <= (max(1, size // 100) if size > 10 else 0)


_is_set_aside = False


def set_aside() -> None:
    """Make the collector skip all that is there now, after a compilation.

    Compilation leaves millions of permanent objects. Python's collector would scan them again and again,
    which takes up to a third of a training.
    """
    global _is_set_aside
    gc.collect()
    gc.freeze()
    _is_set_aside = True


@contextmanager
def cleared_up() -> Iterator[None]:
    """Free what a training leaves in reference cycles, such as replay buffers, which a process that goes on
    would keep. One during which code was compiled was set aside with it, and is freed before the next one,
    which looks at all objects once more and takes half a second."""
    global _is_set_aside
    if _is_set_aside:
        with CLOCK.running("what was learned by"):  # a late part of compiling
            gc.unfreeze()
            gc.collect()
            gc.freeze()
        _is_set_aside = False
    try:
        yield
    finally:
        if not _is_set_aside:
            gc.collect()
