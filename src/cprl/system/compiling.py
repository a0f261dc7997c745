"""Compile functions of tensors by torch, and call them without torch's checks while shapes stay the same.

Compiled code is shared within the process: another learner whose arguments have the same form uses it too, if
torch's guards hold for them. Weights, moments, buffers and other tensors are arguments, read at each call.
Everything else that the code depends on is guarded, so a learner that differs in it compiles its own code.
"""

import gc
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from types import CodeType, FunctionType
from typing import Any, Final, NamedTuple

import torch

from cprl.system.compat.torch_compile import (
    COMPILE_OPTIONS,
    NO_GUARDS,
    compiled_code,
    every_guard,
    guards_hold,
    quiet_about_fallbacks,
    sound_local_buffers,
    trusted_vector_instructions,
    with_new_code,
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
"""The cure where tensordict makes a new parameter, as it does by default, which torch cannot compile."""


class _SharedForm(NamedTuple):
    form: Hashable
    guarded: Any
    """The function by whose code object torch finds its guards."""
    direct: Any
    """The compiled code, called directly."""


_shared: Final[dict[CodeType, list[_SharedForm]]] = {}
"""Compiled forms by the code object of the plain function, the oldest first."""


class Compiled:
    """A function of tensors, compiled at its first call and again when the form of its arguments changes.

    The form of arguments is everything but the values of their tensors. At the first call with a form, the
    function also runs uncompiled, on copies, and the results are compared. If the compilation fails or the
    results differ, the function warns once and runs uncompiled from then on. Functions that draw random
    numbers are not compared, because compiled code may draw different ones.

    Args:
        function: a plain function; values other than tensors are constants from the first call on.
        what: subject and verb for warnings, which go on with "uncompiled", e.g. "agents act".
        changes: the positions of the arguments that the function changes in place, tensors or lists of
            tensors.
        enabled: whether the function is compiled at all.
    """

    def __init__(
        self, function: Callable[..., Any], *, what: str, changes: Sequence[int] = (), enabled: bool = True
    ) -> None:
        self._plain: Any = function
        self._what = what
        self.enabled = enabled
        self._changes = tuple(changes)
        self._compiled: Callable[..., Any] | None = None
        self._form: Hashable = None

    def __call__(self, form: Hashable, *arguments: Any) -> Any:
        """Call the function.

        Args:
            form: everything about the arguments that may change, except tensor values: shapes, dtypes,
                numbers.
        """
        if not self.enabled:
            return self._plain(*arguments)
        if self._compiled is not None and form == self._form:
            return self._compiled(*arguments)
        self._form = form
        with CLOCK.running("what agents learn by (about half a minute, once)"):
            return self._compile_and_call(*arguments)

    def _compile_and_call(self, *arguments: Any) -> Any:
        """Call the function with arguments of a new form, by shared code or by code that is compiled now."""
        before = self._copies(arguments)
        reference = self._plain_outcome(before)
        for shared in _shared_forms(self._plain, self._form, arguments):
            self._compiled = shared.direct
            result = self._compiled(*arguments)
            if self._difference(result, arguments, before, reference) is None:
                return result
            self._restore(arguments, [before[index] for index in self._changes])
        function = with_new_code(self._plain)
        try:
            result, is_guarded = self._compile(function, arguments)
        except Exception as error:  # no argument has been changed yet
            cure = _TO_MODULE_CURE if "torch.nn.Parameter()" in str(error) else ""
            self._run_uncompiled("torch.compile failed", f"{cure}: {error}")
            return self._plain(*arguments)
        freeze_objects()
        difference = self._difference(result, arguments, before, reference)
        if difference is not None:
            largest = f"by up to {difference:.3g}"
            self._run_uncompiled(f"the results of compiled code differ {largest} from uncompiled code")
            self._restore(arguments, reference[1:])
            return reference[0]
        self._keep(function, is_guarded=is_guarded)
        return result

    def _run_uncompiled(self, problem: str, details: str = "") -> None:
        """Warn of a problem, and run uncompiled from now on."""
        self.enabled = False
        consequence = f"{self._what} uncompiled and several times slower"
        warnings.warn(f"{problem}, {consequence}{details}", RuntimeWarning, stacklevel=5)

    def _keep(self, function: FunctionType, *, is_guarded: bool) -> None:
        """Keep the compiled code of a function, and share it if torch can tell which arguments it fits."""
        code = compiled_code(function)
        if code is None:
            return
        self._compiled = without_lookup(function, code)
        if is_guarded:
            _share(self._plain, _SharedForm(self._form, function, self._compiled))

    def _compile(self, function: FunctionType, arguments: Sequence[Any]) -> tuple[Any, bool]:
        """Compile and call; return the result, and whether torch can tell which arguments the code fits."""
        for further in ({}, NO_GUARDS):
            options = {**COMPILE_OPTIONS, **further}  # a copy, since torch removes entries
            # Not dynamic: torch remembers sizes and numbers of other learners, and would make those of this
            # one variables of the code.
            self._compiled = torch.compile(function, fullgraph=True, dynamic=False, options=options)
            try:
                with (
                    warnings.catch_warnings(),
                    every_guard(),
                    sound_local_buffers(),
                    trusted_vector_instructions(),
                    quiet_about_fallbacks(),
                ):
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
        """Return by how much a call differs from the plain function; None if they agree or it draws
        numbers."""
        outcome = [result, *(arguments[index] for index in self._changes)]
        difference = largest_difference(outcome, reference)
        return None if difference is None or self._is_random(before) else difference

    def _restore(self, arguments: Sequence[Any], values: Sequence[Any]) -> None:
        for index, right in zip(self._changes, values, strict=True):
            for tensor, value in zip(tensors_in(arguments[index]), tensors_in(right), strict=True):
                tensor.copy_(value)

    def _copies(self, arguments: Sequence[Any]) -> list[Any]:
        return [copied(value) if index in self._changes else value for index, value in enumerate(arguments)]

    def _plain_outcome(self, arguments: Sequence[Any], *, seed: int | None = None) -> list[Any]:
        """Return the result of the plain function, and the changed arguments as copies; the arguments and
        torch's generators are left unchanged."""
        copies = self._copies(arguments)
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            if seed is not None:
                torch.manual_seed(seed)
            result = self._plain(*copies)
        return [result, *(copies[index] for index in self._changes)]

    def _is_random(self, arguments: Sequence[Any]) -> bool:
        first, second = (self._plain_outcome(arguments, seed=seed) for seed in (1, 2))
        return largest_difference(first, second) is not None


def _shared_forms(plain: FunctionType, form: Hashable, arguments: Sequence[Any]) -> Iterator[_SharedForm]:
    for shared in list(_shared.get(plain.__code__, ())):
        if shared.form == form and guards_hold(shared.guarded, arguments):
            yield shared


def _share(plain: FunctionType, compiled: _SharedForm) -> None:
    newest = _shared.setdefault(plain.__code__, [])
    newest.append(compiled)
    del newest[:-MOST_SHARED]


def copied(value: Any) -> Any:
    return [copied(tensor) for tensor in value] if isinstance(value, list) else value.clone()


def tensors_in(value: Any) -> list[torch.Tensor]:
    return [tensor for part in value for tensor in tensors_in(part)] if isinstance(value, list) else [value]


def largest_difference(results: Sequence[Any], reference: Sequence[Any]) -> float | None:
    """Return the largest difference between tensors that do not agree; None if all agree.

    Numbers agree within `TOLERANCE`, or a thousandth of the largest number of their tensor if that is less.
    One number in a hundred of a tensor, and at least one of more than ten, may differ more: the first updates
    of Adam and RMSprop turn a gradient that is only rounding error into a full step.
    """
    pairs = list(zip(tensors_in(list(results)), tensors_in(list(reference)), strict=True))
    if all(_agree(*pair) for pair in pairs):
        return None
    return max(float((a.double() - b.double()).abs().max()) for a, b in pairs if a.numel())


def _agree(result: torch.Tensor, reference: torch.Tensor) -> bool:
    size = reference.numel()
    if not size:
        return True
    scale = float(reference.double().abs().max()) if reference.isfinite().all() else 1.0
    near = min(TOLERANCE, 10 * TOLERANCE * scale) + 1e-8
    off = ~torch.isclose(result.double(), reference.double(), TOLERANCE, near, equal_nan=True)
    return int(off.sum()) <= (max(1, size // 100) if size > 10 else 0)


_is_set_aside = False


def freeze_objects() -> None:
    """Make the garbage collector skip all objects that exist now, after a compilation.

    Compilation leaves millions of permanent objects. Python's collector would scan them again and again,
    which takes up to a third of a training.
    """
    global _is_set_aside
    gc.collect()
    gc.freeze()
    _is_set_aside = True


@contextmanager
def freed_after_training() -> Iterator[None]:
    """Free what a training in the block leaves in reference cycles, such as replay buffers.

    Objects of a training during which code was compiled are set aside with that code. They are freed before
    the next training, which takes half a second.
    """
    global _is_set_aside
    if _is_set_aside:
        with CLOCK.running("what was learned by"):  # counts as compilation
            gc.unfreeze()
            gc.collect()
            gc.freeze()
        _is_set_aside = False
    try:
        yield
    finally:
        if not _is_set_aside:
            gc.collect()
