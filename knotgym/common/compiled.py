"""Compiled functions that only compiled code calls.

Numba optimizes a function, makes machine code of it, and optimizes it once more in each function
that calls it, where it is most often inlined. What `inner` decorates is left nearly as it was
written until a function that Python calls, such as one decorated with `njit(cache=True)`, takes it
in and is optimized as a whole. No bit of a result differs, and much of the compilation is saved.

After a change run `python benchmarks/step.py`: ropes must be stepped as fast as before. That is why
the large functions of `rope.chain` aren't `inner`, which would save another 2 s and cost 2 %.
"""

from typing import Any

from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _Unfinished(JITCodeLibrary):
    """Code to be taken in by that of other functions; it is never in memory to be run."""

    def _optimize_final_module(self) -> None:
        """Leave it to the function that takes it in; passes over single functions are done."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, which stands for no machine code."""
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> Any:
        """Itself, of which Numba asks only that it keep the function's globals, see `set_env`."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Keep nothing: code that isn't run has no globals."""


class _Inner(Compiler):
    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        super().__init__(typing, target, _Unfinished(target.codegen(), "inner"), *rest)


# Called from Python such functions crash.
inner = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, pipeline_class=_Inner)
