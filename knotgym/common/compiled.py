"""The decorator of functions that only compiled code calls.

Numba makes wrappers of each function through which Python and C could call it. Without them a tenth
of the compilation is saved, and no bit of a result differs. Called from Python such functions
crash, so tests call them through one that has wrappers.
"""

from numba import njit

inner = njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
