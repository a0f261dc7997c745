"""torch.compile: its options, its cache of compiled code, and its guards."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from types import CodeType, FunctionType
from typing import Any, Final
from unittest.mock import patch

import torch

from cprl.system.libraries import relying_on, require

require("torch", torch.compiler, "skip_all_guards_unsafe")

COMPILE_OPTIONS: Final[Mapping[str, Any]] = {
    "cpp_wrapper": True,
    "cpp.threads": 1,
    "cpp_cache_precompile_headers": False,
}
"""Options of `torch.compile`. Compiled code runs in one thread; torch's threads, whatever their number, are
for matrix products. With two threads in compiled code as well, a training was thirty times slower, presumably
because the threads of two OpenMP runtimes block each other's cores while they wait. To precompile headers
takes five seconds of a processor and 140 MB for each set of options, and then saves nothing."""

NO_GUARDS: Final[Mapping[str, Any]] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
"""Further options, for functions whose guards torch itself finds broken; `guards_hold` must not be asked
then."""


def every_guard() -> AbstractContextManager[Any]:
    """Make torch also guard against hooks of modules and against shared parameters, in a context.

    Torch leaves these guards out because they take time at each call; here they are checked once for each
    learner, by `guards_hold`.
    """
    with relying_on("torch", "torch._dynamo.config with the settings of guards"):
        import torch._dynamo  # takes a second

        patched: AbstractContextManager[Any] = torch._dynamo.config.patch(
            skip_nnmodule_hook_guards=False, skip_no_tensor_aliasing_guards_on_parameters=False
        )
    return patched


def sound_local_buffers() -> AbstractContextManager[Any]:
    """Work around a KeyError of torch 2.13 in a context, see pytorch/pytorch#196570.

    Torch looks up a read of a buffer that an operation changes in place, by a name that is never read, when
    it fuses loops. Here such a lookup returns None. IPPO with five teams of four on `commons` needs it.
    """
    with relying_on("torch", "torch._inductor.loop_body.LoopBody.get_read_expr"):
        from torch._inductor.loop_body import LoopBody  # takes a second

        find: Any = LoopBody.get_read_expr

    def read_of(body: Any, buffer_name: str) -> Any:
        """Return the index of a read; None, which equals no index, if there is no such read."""
        with suppress(KeyError):
            return find(body, buffer_name)
        return None

    return patch.object(LoopBody, "get_read_expr", read_of)


def with_new_code(function: Any) -> FunctionType:
    """Return the same function with a new code object. Torch caches compiled code by code object, and would
    treat another learner's sizes as a change of shapes."""
    code = function.__code__.replace(co_name=f"{function.__name__}_of_its_own")
    return FunctionType(code, function.__globals__, code.co_name)


def compiled_code(function: FunctionType) -> CodeType | None:
    """Return the code that torch compiled last for a function from `with_new_code`; None if there is none."""
    entries = _compiled_entries(function)
    return entries[-1].code if entries else None


def _compiled_entries(function: FunctionType) -> Any:
    """Return torch's cache entries of a function, the last compiled last."""
    with relying_on("torch", "torch._C._dynamo.eval_frame._debug_get_cache_entry_list"):
        from torch._C._dynamo.eval_frame import _debug_get_cache_entry_list

    return _debug_get_cache_entry_list(function.__code__)


def guards_hold(function: FunctionType, arguments: Sequence[Any]) -> bool:
    """Return whether all of torch's guards of `compiled_code` hold for arguments, as torch asks at each call.

    Guards are everything about the arguments, and about what can be reached from them, that the code takes
    for granted: types, functions, the numbers and texts that are constants in it, and the forms of tensors,
    whose values never are.
    """
    with relying_on("torch", "torch._dynamo.guards.DeletedGuardManagerWrapper"):
        from torch._dynamo.guards import DeletedGuardManagerWrapper

    entries = _compiled_entries(function)
    guards = entries[-1].guard_manager if entries else None
    # Deleted guards, of code that depended on an object that is gone, would hold for everything.
    if guards is None or isinstance(guards, DeletedGuardManagerWrapper):
        return False
    return bool(guards.check(dict(zip(function.__code__.co_varnames, arguments, strict=False))))


def without_lookup(function: FunctionType, code: CodeType) -> FunctionType:
    """Return the code that torch compiled for a function, to be called directly.

    Torch's lookup of it at every call takes half of the overhead of a call, and the guards a quarter of an
    update of 16 agents. Without them the caller must compile again when the form of arguments changes, as
    `cprl.system.compiling` does. The globals are a copy: torch stores names in them that it may delete.

    Args:
        function: from `with_new_code`.
        code: from `compiled_code`.
    """
    return FunctionType(code, dict(function.__globals__), function.__name__)


@contextmanager
def quiet_about_fallbacks() -> Iterator[None]:
    """Silence torch's warnings about operations, such as sampling, that compiled code calls by torch's
    dispatcher; the results are the same."""

    def says_more(record: logging.LogRecord) -> bool:
        return "missing a c-shim" not in str(record.msg)

    torch_log = logging.getLogger("torch._inductor.ir")
    torch_log.addFilter(says_more)
    try:
        yield
    finally:
        torch_log.removeFilter(says_more)


def trusted_vector_instructions() -> AbstractContextManager[Any]:
    """Make torch use the vector instructions of the CPU in a context, without asking its compiler.

    By default torch compiles a library for each set of instructions and loads it in a new process, which
    takes eight seconds of a processor. All compilers that can read torch's headers know these sets, but for
    AMX, which is left out: only products of matrices use it, and those are not compiled.
    """
    with relying_on("torch", "torch._inductor.cpu_vec_isa.VecISA.check_build"):
        from torch._inductor.cpu_vec_isa import VecISA  # takes a second

        name = VecISA.check_build.__name__

    return patch.object(VecISA, name, lambda kind, _: "amx" not in str(kind))
