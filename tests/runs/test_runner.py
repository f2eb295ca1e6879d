"""The contract of runs: the same bytes however they are interrupted, divided and executed; nothing
is lost or replaced unasked.
"""

import errno
import fcntl
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Barrier
from typing import Annotated

import pytest
from pytest_types import Capture, Patch

from knotgym.common import Failed, InvalidInput, Mark, MissingFile, Occupied, sha256
from knotgym.control import PolicyConfig
from knotgym.runs.identities import Identity, identity
from knotgym.runs.journal import Journal
from knotgym.runs.run_options import RunOptions, Shard
from knotgym.runs.runner import Call, Recipe, _staging_folder, compute, run

from ..scripts import ROOT
from .recipes import RECIPES, content, drawn, made_toy, toy

QUIET = RunOptions(workers=1, quiet=True)
RESUMED = replace(QUIET, resume=True)
KILLS = 2

every_recipe = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "toy" else pytest.mark.slow) for name in RECIPES],
)
Unbroken = Callable[[str], dict[str, bytes]]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Unbroken:
    """The files of an unbroken run of a recipe, made when they are first asked for."""

    @cache
    def made(name: str) -> dict[str, bytes]:
        return content(RECIPES[name](tmp_path_factory.mktemp("unbroken") / name, QUIET))

    return made


@every_recipe
def test_processes_change_no_byte(
    name: str, tmp_path: Path, unbroken: Unbroken, monkeypatch: Patch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))  # workers import the recipes by name
    out = RECIPES[name](tmp_path / name, replace(QUIET, workers=2))
    assert content(out) == unbroken(name)
    assert list(tmp_path.iterdir()) == [out]


@every_recipe
def test_a_run_that_is_killed_again_and_again_makes_the_same_bytes(
    name: str, tmp_path: Path, unbroken: Unbroken
) -> None:
    out, rng, kills = tmp_path / name, random.Random(name), 0
    journal = _staging_folder(out) / "journal"
    command = [sys.executable, "-m", "tests.runs.recipes", name, str(out), "1"]
    size = 0
    for _ in range(KILLS + 1):
        child = subprocess.Popen(command)
        while kills < KILLS and child.poll() is None and _size(journal) <= size:
            time.sleep(0.001)  # until the journal grows
        if kills < KILLS and child.poll() is None:
            time.sleep(rng.random() * 0.02)
            os.kill(child.pid, signal.SIGKILL)
            kills += 1
        assert child.wait() in (0, -signal.SIGKILL)
        size = _size(journal)
    assert kills
    assert content(out) == unbroken(name)
    assert list(tmp_path.iterdir()) == [out]


@every_recipe
def test_three_shards_make_the_same_bytes(
    name: str, tmp_path: Path, unbroken: Unbroken, capsys: Capture
) -> None:
    out, make = tmp_path / name, RECIPES[name]
    for number in (2, 1, 3):
        left = make(out, replace(QUIET, shard=Shard(number, 3)))
        assert left == tmp_path / f"{name}-shard-{number}-of-3.journal"
    for number in (1, 2, 3, 1, 2, 3):  # what depends on the others' results
        make(out, replace(RESUMED, shard=Shard(number, 3)))
    assert not out.exists()
    capsys.readouterr()
    assert content(make(out, replace(QUIET, quiet=False))) == unbroken(name)
    said = capsys.readouterr().out
    assert "not needed any more" in said and f"{name}-shard-3-of-3.journal" in said


def test_a_shard_without_work_says_so(tmp_path: Path, capsys: Capture) -> None:
    made_toy(tmp_path / "a", RunOptions(workers=1, shard=Shard(31, 31)))
    assert "shard 31/31 has nothing to do" in capsys.readouterr().out


def test_a_shard_computes_its_share_and_names_the_others(tmp_path: Path, capsys: Capture) -> None:
    path = made_toy(tmp_path / "a", RunOptions(workers=1, shard=Shard(2, 3)))
    assert "run shard 1/3, 3/3" in capsys.readouterr().out
    with Journal(path, {"config": {"toy": 0}}) as journal:
        assert set(journal) == {f"parts {number}" for number in range(1, 30, 3)}
    before, again = content(path), replace(QUIET, shard=Shard(2, 3))
    with pytest.raises(Occupied, match="--resume continues it, --restart deletes it"):
        made_toy(tmp_path / "a", again)
    assert content(path) == before
    made_toy(tmp_path / "a", replace(again, restart=True))
    assert content(path) == before
    with pytest.raises(InvalidInput, match="shard-2-of-3.journal belongs to a different run"):
        run(toy, tmp_path / "a", Identity({"config": {"toy": 1}}), QUIET)
    assert [path.name for path in tmp_path.iterdir()] == ["a-shard-2-of-3.journal"]


def test_results_stay_in_memory_without_a_journal_and_threads_compute_too() -> None:
    def recipe() -> Recipe[float]:
        parts = yield [Call(f"parts {number}", drawn, (0, number, 1.0)) for number in range(5)]
        return float(sum(part["x"].sum() for part in parts))

    alone = compute(recipe())
    with ThreadPoolExecutor(2) as pool:
        assert compute(recipe(), pool=pool) == alone
    with pytest.raises(Failed, match="run shard 2/2"):
        compute(recipe(), shard=Shard(1, 2))


def interrupted(out: Path, after: int = 7) -> None:
    """Leave a run that was interrupted after some results."""
    kept = Journal.__setitem__

    def keep(self: Journal, *arguments: object) -> None:
        kept(self, *arguments)  # type: ignore[arg-type]
        if len(self) == after:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Journal, "__setitem__", keep)
        made_toy(out, QUIET)


def test_an_interrupted_run_is_continued_or_deleted_only_on_request(tmp_path: Path) -> None:
    out = tmp_path / "a"
    interrupted(out)
    assert not out.exists()
    with pytest.raises(Occupied, match="--resume continues it, --restart deletes it"):
        made_toy(out, QUIET)
    with pytest.raises(InvalidInput, match="toy is 0 there and 1 here"):
        run(toy, out, Identity({"config": {"toy": 1}}), RESUMED)
    run(toy, out, Identity({"config": {"toy": 1}}), replace(QUIET, restart=True))
    with pytest.raises(Occupied):
        made_toy(out, QUIET)
    assert made_toy(out, replace(QUIET, overwrite=True)) == out


def test_a_finished_output_is_found_before_any_call(tmp_path: Path, monkeypatch: Patch) -> None:
    out = made_toy(tmp_path / "a", QUIET)
    monkeypatch.setattr("tests.runs.recipes.drawn", None)
    with pytest.raises(Occupied, match="exists already; --overwrite replaces it"):
        made_toy(out, QUIET)
    _staging_folder(out).mkdir()  # as if killed after its output was in place
    assert made_toy(out, RESUMED) == out
    assert list(tmp_path.iterdir()) == [out]


def test_what_is_there_is_not_computed_again(tmp_path: Path) -> None:
    interrupted(tmp_path / "a", after=30)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(TypeError):
        patch.setattr("tests.runs.recipes.drawn", None)  # which the next batch calls
        made_toy(tmp_path / "a", RESUMED)
    assert made_toy(tmp_path / "a", RESUMED)


def test_a_failure_before_any_result_leaves_nothing(tmp_path: Path) -> None:
    def recipe(_: Path) -> Recipe[None]:
        yield [Call("one 1", drawn, ("no number", 0, 1.0))]

    with pytest.raises(ValueError, match="unrecognized seed"):
        run(recipe, tmp_path / "a", Identity(), QUIET)
    assert list(tmp_path.iterdir()) == []


@dataclass(frozen=True)
class Reading:
    """A configuration that names files."""

    states: Annotated[str, Mark("states")]
    policies: tuple[PolicyConfig, ...] = ()


def test_a_run_digests_what_its_fields_name_and_never_replaces_it(tmp_path: Path) -> None:
    (tmp_path / "own.h5").write_text("1")
    (tmp_path / "mine.py").write_text("1")
    (tmp_path / "folder").mkdir()
    source, more = tmp_path / "own.h5", {"also": [tmp_path / "mine.py"], "name": "mine"}
    made = identity(Reading(str(source), (PolicyConfig(policy="expert"),)), more, fields={})
    assert made["source"]["states"] == {"own": sha256(source)}
    assert len(made["source"]["policies"]["expert"]) == 2
    assert made["source"]["also"] == [sha256(tmp_path / "mine.py")]
    assert made["source"]["name"] == "mine"
    over = replace(QUIET, overwrite=True)
    for out in (source, tmp_path / "mine.py", tmp_path, source / "below"):
        with pytest.raises(Occupied, match="is, contains or is in its source"):
            run(toy, out, made, over)

    def recipe(place: Path) -> Recipe[None]:
        yield [Call("one 1", drawn, (0, 0, 1.0))]
        source.write_text("2")
        place.mkdir()

    with pytest.raises(InvalidInput, match="so nothing is written: source.states.own is"):
        run(recipe, tmp_path / "out", made, QUIET)
    assert not (tmp_path / "out").exists()
    with pytest.raises(MissingFile, match="no such file"):
        identity(Reading(str(tmp_path / "none.h5")), fields={})


@pytest.mark.parametrize("existing", [QUIET, RESUMED, replace(QUIET, restart=True)])
def test_of_several_that_begin_at_the_same_moment_one_makes_the_output(
    existing: RunOptions, tmp_path: Path, unbroken: Unbroken
) -> None:
    """Locks are of open files, so threads stand for processes."""
    for number, count in enumerate([2, 8]):
        out, start = tmp_path / str(number) / "toy", Barrier(count)

        def begin(_: int, out: Path = out, start: Barrier = start) -> str:
            start.wait()
            try:
                return str(made_toy(out, existing))
            except Occupied as error:
                return f"refused: {error}"

        with ThreadPoolExecutor(count) as pool:
            ended = list(pool.map(begin, range(count)))
        assert str(out) in ended
        assert {word.partition(":")[0] for word in ended} <= {str(out), "refused"}
        assert content(out) == unbroken("toy")
        assert list(out.parent.iterdir()) == [out]


def test_no_other_user_can_plant_files_in_the_folder(tmp_path: Path) -> None:
    def recipe(place: Path) -> Recipe[None]:
        yield [Call("one 1", drawn, (0, 0, 1.0))]
        assert place.parents[1].stat().st_mode & 0o777 == 0o700
        place.mkdir()

    assert run(recipe, tmp_path / "a", Identity(), QUIET).stat().st_mode & 0o500


def _size(journal: Path) -> int:
    """The number of results."""
    return sum(name.endswith(".npy") for *_, names in os.walk(journal) for name in names)


def test_a_disk_without_locks_is_one_line_and_is_clean(tmp_path: Path, monkeypatch: Patch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(Occupied, match=r"can't be locked \(No locks available\)"):
        made_toy(tmp_path / "a", QUIET)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_removed_under_a_run_ends_it(tmp_path: Path) -> None:
    def recipe(place: Path) -> Recipe[None]:
        yield [Call("one 1", drawn, (0, 0, 1.0))]
        shutil.rmtree(place.parents[1])

    with pytest.raises(Occupied, match="was removed during the run"):
        run(recipe, tmp_path / "a", Identity(), QUIET)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["5/4", "0/4", "4", "a/b", "1/2/3", "-1/2", "1/", "1/99999999"])
def test_a_shard_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match="a shard is i/n with i from 1 to n, such as 2/8; got"):
        Shard.parse(text)
