"""Functions that only compiled code calls, called from Python."""

from collections.abc import Callable
from typing import Any

from numba import njit


def called(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a compiled function that does nothing but call an `inner` one."""

    @njit(nogil=True)
    def caller(*given: Any) -> Any:
        return function(*given)

    return caller
