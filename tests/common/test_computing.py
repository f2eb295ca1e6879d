"""Rows divided among threads: results in order, errors raised, other work done meanwhile. Machine
code is kept by what it is made from, in a folder that is this user's alone.
"""

import inspect
import os
import sys
import threading
from pathlib import Path

import pytest

from knotgym.common import computing
from knotgym.common.computing import Threads
from knotgym.topology import scan

ROOT = Path(__file__).parents[2]
counts = pytest.mark.parametrize("count", [1, 3])


@counts
@pytest.mark.parametrize(("rows", "unit", "most"), [(0, 1, None), (7, 1, 2), (50, 4, None)])
def test_every_row_is_worked_on_once_and_results_are_in_order(
    count: int, rows: int, unit: int, most: int | None
) -> None:
    parts = Threads(count).spread(lambda part: range(rows)[part], rows, unit, most=most)
    assert [row for part in parts for row in part] == list(range(rows))
    assert all(len(part) <= (most or rows) and part.start % unit == 0 for part in parts)


@counts
def test_the_first_error_is_raised_once_all_rows_are_done(count: int) -> None:
    done = set[int]()

    def work(part: slice) -> None:
        if part.start % 2:
            raise ValueError(f"row {part.start}")
        done.add(part.start)

    threads = Threads(count)
    with pytest.raises(ValueError, match="row 1"):
        threads.spread(work, 7, most=1)
    assert done == {0, 2, 4, 6}
    assert threads.spread(lambda part: part.start, 2, most=1) == [0, 1]  # they still work


def test_other_work_is_done_while_the_threads_are_at_theirs() -> None:
    at_work, is_done = threading.Event(), threading.Event()

    def work(part: slice) -> bool:
        if threading.current_thread() is threading.main_thread():
            return True
        at_work.set()
        return is_done.wait(60)

    def meanwhile() -> None:
        assert at_work.wait(60)
        is_done.set()

    assert Threads(2).spread(work, 2, meanwhile=meanwhile) == [True, True]
    Threads(1).spread(work, 2, meanwhile=is_done.clear)
    assert not is_done.is_set()


def test_threads_end_with_their_pool() -> None:
    before, pool = {*threading.enumerate()}, Threads(3)
    pool.spread(lambda part: None, 3)
    ours = {*threading.enumerate()} - before
    assert len(ours) == 2
    del pool
    for one in ours:
        one.join(timeout=60)
        assert not one.is_alive()


@pytest.mark.parametrize(
    ("quotas", "expected"),
    [
        ({}, 8),
        ({"": "200000 100000"}, 2),
        ({"": "300000 100000", "pod": "max 100000", "pod/own": "10000 100000"}, 1),
        ({"": "nonsense"}, 8),
    ],
)
def test_cores_are_those_that_affinity_and_the_container_s_quota_leave(
    quotas: dict[str, str], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pod/own").mkdir(parents=True)
    for group, quota in quotas.items():
        (tmp_path / group / "cpu.max").write_text(quota + "\n")
    read = Path.read_text

    def text(path: Path) -> str:
        return "0::/pod/own\n" if path == Path("/proc/self/cgroup") else read(path)

    monkeypatch.setattr(computing, "_CGROUPS", tmp_path)
    monkeypatch.setattr(Path, "read_text", text)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert Threads.cores() == expected == Threads(0)._most


def test_machine_code_is_known_by_the_sources_it_is_made_from_and_not_by_their_path() -> None:
    own, called = (
        sys.modules[f"knotgym.topology.{name}"] for name in ("crossing_kernel", "exact_signs")
    )
    made_from = [*computing._sources(own, set())]
    assert {inspect.getsource(own), inspect.getsource(called)} < set(made_from)
    assert str(ROOT) not in "".join(made_from)
    kept = Path(scan.stats.cache_path)
    assert kept.parent == computing._machine_code() and not kept.is_relative_to(ROOT)


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Choose the folder of machine code again; the user's cache folder has this one."""
    computing._machine_code.cache_clear()
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(computing, "__file__", str(tmp_path / "package" / "computing.py"))
    return tmp_path / "cache" / "knotgym"


@pytest.mark.skipif(os.name == "nt", reason="folders there have no such modes")
def test_machine_code_lies_where_only_this_user_writes(
    kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        own = computing._machine_code()
        assert own.parent == kept and own.stat().st_mode & 0o777 == 0o700
        own.chmod(0o770)  # others may have put code there
        computing._machine_code.cache_clear()
        beside = computing._machine_code()
        assert beside.parent.name == "__pycache__" and not beside.is_relative_to(kept)
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
        computing._machine_code.cache_clear()
        assert computing._machine_code().name.startswith("knotgym-numba-")
    finally:
        computing._machine_code.cache_clear()


def test_machine_code_is_temporary_where_no_folder_can_be_searched(
    kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    try:
        monkeypatch.setattr(Path, "mkdir", refuse)
        assert computing._machine_code().name.startswith("knotgym-numba-")
        assert os.environ["NUMBA_CACHE_DIR"] == str(computing._machine_code())  # for workers
    finally:
        computing._machine_code.cache_clear()
