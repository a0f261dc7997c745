"""Compiled: a function that torch compiles, called without guards where its arguments keep their form."""

import gc
import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from types import CodeType, FunctionType
from typing import Any, Final

import torch

OPTIONS: Final[dict[str, Any]] = {
    "cpp_wrapper": True,
    "guard_filter_fn": torch.compiler.skip_all_guards_unsafe,
}
"""Of torch.compile, which takes some out of the dict it is given. Guards cost a quarter of an update of 16
lanes; whoever calls tells the form instead."""


class Compiled:
    """A function of tensors, compiled at its first call and again when the form of its arguments changes.

    Where it cannot be compiled a warning says so once, and it runs as it is.

    Args:
        function: a plain function; whatever it reads besides tensors is taken as it was at the first call.
        what: what it does, for the warning.
        enabled: whether it is compiled at all.
    """

    def __init__(self, function: Callable[..., Any], *, what: str, enabled: bool = True) -> None:
        self._plain, self._what, self.enabled = function, what, enabled
        self._compiled: Callable[..., Any] | None = None
        self._form: Hashable = None

    def __call__(self, form: Hashable, *arguments: Any) -> Any:
        """What the function gives.

        Args:
            form: all that may change of the arguments but their values: shapes, types, numbers.
            arguments: of the function.
        """
        if not self.enabled:
            return self._plain(*arguments)
        if self._compiled is not None and form == self._form:
            return self._compiled(*arguments)
        self._form = form
        return self._compile_and_call(*arguments)

    def _compile_and_call(self, *arguments: Any) -> Any:
        """The first call with this form; where it cannot be compiled, nothing has been changed yet."""
        own = _own_code(self._plain)
        self._compiled = torch.compile(own, fullgraph=True, options=dict(OPTIONS))
        try:
            with warnings.catch_warnings(), _rewritten(own) as codes:
                for kind in (DeprecationWarning, FutureWarning):  # torch's and TorchRL's own affairs
                    warnings.simplefilter("ignore", kind)
                result = self._compiled(*arguments)
        except Exception as error:
            self.enabled = False
            warnings.warn(
                f"torch.compile failed, {self._what} uncompiled and several times slower: {error}",
                RuntimeWarning,
                stacklevel=4,
            )
            return self._plain(*arguments)
        if codes:
            # What the function has become, called without looking for it at every call, which takes half of
            # torch's time around the computation. With globals of its own: torch clears away its own names.
            self._compiled = FunctionType(codes[-1], dict(own.__globals__), own.__name__)
        # A compiler leaves millions of objects that stay; without this Python's garbage collector looks
        # through them again and again, which takes up to a third of a training.
        gc.collect()
        gc.freeze()
        return result


@contextmanager
def _rewritten(function: FunctionType) -> Iterator[list[CodeType]]:
    """While it is open, the code that torch writes in place of a function's is put into the list."""
    from torch._dynamo.convert_frame import register_bytecode_hook  # takes seconds

    codes: list[CodeType] = []

    def keep(code: CodeType, new_code: CodeType) -> None:
        if code is function.__code__:
            codes.append(new_code)

    hook = register_bytecode_hook(keep)
    try:
        yield codes
    finally:
        hook.remove()


def _own_code(function: Any) -> FunctionType:
    """The same function with a code object of its own: torch keeps what it compiled by code object, and
    would take learners of another size for a change of shapes."""
    code = function.__code__.replace(co_name=f"{function.__name__}_of_its_own")
    return FunctionType(code, function.__globals__, code.co_name)
