"""The decorators of functions that only compiled code calls, and what makes compiling cheaper.

Numba makes wrappers of each function through which Python and C could call it. Without them a tenth
of the compilation is saved, and no bit of a result differs. Called from Python such functions
crash, so tests call `njit(function.py_func)`. A function that is called in one place is compiled
faster as part of its caller, unless it is long: then Numba's analysis takes more than LLVM saves.

`python benchmarks/compiled.py COMMAND` lists what a command compiles.
"""

import gc
from typing import Any

from numba import njit
from numba.core import event

# 1 / 0 is infinite and 0 / 0 NaN, as in NumPy: no branches are compiled that raise an exception
inner = njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
inlined = njit(nogil=True, inline="always", no_cpython_wrapper=True, no_cfunc_wrapper=True)


class _FewCollections(event.Listener):
    """Look for garbage rarely while a function is compiled: that is a tenth of the time.

    Numba allocates so much that a collection of everything, which takes 0.2 s, comes every second.
    """

    def __init__(self) -> None:
        self._usual: list[tuple[int, int, int]] = []  # of the functions that are being compiled

    def on_start(self, event: Any) -> None:
        self._usual.append(gc.get_threshold())
        if self._usual[0][0]:  # 0: no collections
            gc.set_threshold(max(10_000, self._usual[0][0]), 50, 50)

    def on_end(self, event: Any) -> None:
        gc.set_threshold(*self._usual.pop())


event.register("numba:compile", _FewCollections())
