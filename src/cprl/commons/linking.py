"""Rules as parts of one piece of machine code, which LLVM optimises once.

Numba optimises each function with all that it calls, and makes machine code of it, so that a rule that is
called by rules that are called by others is compiled again in each of them: that took half of the time.

Private parts of Numba: the libraries of its code generator, and how its compiler makes them.
"""

from typing import Any, Final

from cprl.system.libraries import relying_on

with relying_on("numba", "numba._dynfunc, JITCodeLibrary and Compiler"):
    from numba import _dynfunc  # type: ignore[attr-defined]
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler


class _Part(JITCodeLibrary):
    """The code of a function that is called by others alone: not linked, and no machine code."""

    def finalize(self) -> None:
        self._raise_if_finalized()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def _get_module_for_linking(self) -> Any:
        """Return the code as it is: what Numba marks as "linkonce" LLVM leaves out where it is linked before
        that which calls it."""
        self._ensure_finalized()
        return self._final_module


class _Whole(JITCodeLibrary):
    """The code of a function with that of all the parts that it calls, at whatever depth."""

    def finalize(self) -> None:
        libraries: dict[Any, None] = {}
        waiting = list(self._linking_libraries)
        while waiting:
            library = waiting.pop()
            if library not in libraries:
                libraries[library] = None
                if isinstance(library, _Part):
                    waiting += library._linking_libraries
        # Parts first, so that what they call, "linkonce", is linked.
        self._linking_libraries = sorted(libraries, key=lambda library: not isinstance(library, _Part))
        super().finalize()

    def _optimize_final_module(self) -> None:
        parts = (library for library in self._linking_libraries if isinstance(library, _Part))
        for part in parts:
            for function in part.get_defined_functions():
                self._final_module.get_function(function.name).linkage = "internal"
        super()._optimize_final_module()


class _ToWhole(Compiler):
    """Numba's compiler, for an entry."""

    library: Any = _Whole

    def _compile_core(self) -> Any:
        state = self.state
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super()._compile_core()


class _ToPart(_ToWhole):
    """Numba's compiler, for what an entry calls."""

    library = _Part

    def _compile_core(self) -> Any:
        self.state.flags.no_compile = True
        made = super()._compile_core()
        form, library = made.fndesc, self.state.library
        library._ensure_finalized()
        key = _dynfunc.make_function(form.lookup_module(), form.qualname, "", 0, made.environment, (library,))
        self.state.targetctx.insert_user_function(key, form, [library])
        return made._replace(entry_point=key)


AS_WHOLE: Final = {"pipeline_class": _ToWhole}
AS_PART: Final = {"pipeline_class": _ToPart}
"""Options of `numba.njit`, of an entry and of what it calls. A part can be called by compiled code alone."""
