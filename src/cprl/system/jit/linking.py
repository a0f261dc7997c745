"""Link all rules to one piece of machine code, which LLVM optimises only once.

By default Numba optimises each function together with all functions that it calls, and makes machine code of
it. So a rule is compiled again for every function that calls it, directly or through others, which took half
of the time to compile. Here the rules stay parts without machine code, and only the entry is compiled.

This uses private parts of Numba: the libraries of its code generator, and the steps of its compiler.
"""

from typing import Any, Final

from cprl.system.libraries import relying_on

with relying_on("numba", "numba._dynfunc, JITCodeLibrary and Compiler"):
    from numba import _dynfunc  # type: ignore[attr-defined]
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler


class _Part(JITCodeLibrary):
    """The library of a function that only compiled functions call: neither linked nor made machine code."""

    def finalize(self) -> None:
        self._raise_if_finalized()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def _get_module_for_linking(self) -> Any:
        """Return the module of the code unchanged.

        Numba would mark its functions as "linkonce", and LLVM leaves such functions out if they are linked
        before the functions that call them.
        """
        self._ensure_finalized()
        return self._final_module


class _Whole(JITCodeLibrary):
    """The library of an entry, with all parts that it calls directly or through others."""

    def finalize(self) -> None:
        libraries: dict[Any, None] = {}
        waiting = list(self._linking_libraries)
        while waiting:
            library = waiting.pop()
            if library not in libraries:
                libraries[library] = None
                if isinstance(library, _Part):
                    waiting += library._linking_libraries
        # Parts come first, so that the "linkonce" functions that they call are linked.
        self._linking_libraries = sorted(libraries, key=lambda library: not isinstance(library, _Part))
        super().finalize()

    def _optimize_final_module(self) -> None:
        parts = (library for library in self._linking_libraries if isinstance(library, _Part))
        for part in parts:
            for function in part.get_defined_functions():
                self._final_module.get_function(function.name).linkage = "internal"
        super()._optimize_final_module()


class _ToWhole(Compiler):
    """Numba's compiler for an entry."""

    library: Any = _Whole

    def _compile_core(self) -> Any:
        state = self.state
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super()._compile_core()


class _ToPart(_ToWhole):
    """Numba's compiler for the rules that an entry calls."""

    library = _Part

    def _compile_core(self) -> Any:
        self.state.flags.no_compile = True
        result = super()._compile_core()
        library = self.state.library
        library._ensure_finalized()
        function = result.fndesc
        key = _dynfunc.make_function(
            function.lookup_module(), function.qualname, "", 0, result.environment, (library,)
        )
        self.state.targetctx.insert_user_function(key, function, [library])
        return result._replace(entry_point=key)


AS_WHOLE: Final = {"pipeline_class": _ToWhole}
AS_PART: Final = {"pipeline_class": _ToPart}
"""Options of `numba.njit` for an entry, and for the rules it calls. Only compiled code can call a part."""
