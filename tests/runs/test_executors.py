"""Executors: processes that leave interrupts to their parent."""

import json
import signal
import subprocess
import sys

import pytest

from knotgym.runs.executors import executor

from ..small_job import SECONDS


def _interruptible(_: int) -> bool:
    """Whether a Ctrl-C would reach this process."""
    return signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def _print_interruptible() -> None:
    with executor(2) as pool:
        print(json.dumps([*pool.map(_interruptible, range(2)), _interruptible(0)]))


@pytest.mark.slow
def test_processes_leave_an_interruption_to_their_parent_from_their_first_moment_on() -> None:
    words = [sys.executable, "-c", f"from {__name__} import _print_interruptible as told; told()"]
    told = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS).stdout
    assert json.loads(told) == [False, False, True]
