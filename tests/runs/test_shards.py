"""`--shard i/n` and `knotgym dataset merge`: parts made without knowing of each other make a
whole.
"""

import importlib.util
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidInput
from knotgym.datasets.image_table import points_of, read_rows, read_table
from knotgym.runs.shards import Shard
from knotgym.states.near_duplicates import NEAR, apart, distances

from ..cli.test_generate_command import bytes_of, said
from ..small_job import knotgym, typed

with_arrow = pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None, reason="pyarrow isn't installed"
)


def in_parts(of: int, out: Path, *words: object) -> list[Path]:
    """Give a command once for each of its shards; the folders made."""
    for number in range(1, of + 1):
        assert (
            knotgym(*words, "--workers", 1, "--quiet", "--out", out, "--shard", f"{number}/{of}")
            == 0
        )
    return sorted(out.parent.rglob("*-shard-*-of-*"))


@given(st.integers(1, 50), st.integers(0, 300))
def test_shares_are_even_and_leave_nothing_out(of: int, count: int) -> None:
    shares = [Shard(number, of).share(count) for number in range(1, of + 1)]
    assert [k for share in shares for k in share] == list(range(count)) and len(
        {len(share) for share in shares}
    ) <= 2
    assert [len(Shard(number, of).dealt(range(count))) for number in range(1, of + 1)] == [
        len(share) for share in shares
    ]


@pytest.mark.parametrize("text", ["5/4", "0/4", "4", "a/b", "1/2/3", "-1/2", "1/", "1/99999999"])
@pytest.mark.parametrize("command", ["generate", "collect", "images"])
def test_a_shard_that_is_none_is_one_line(
    command: str, text: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym(command, "--out", tmp_path / "a", f"--shard={text}") == 2
    (line,) = said(capfd)
    assert (
        "a shard is i/n with i from 1 to n, such as 2/8; got" in line
        and text in line
        and list(tmp_path.iterdir()) == []
    )


def test_a_part_reads_as_it_is_written() -> None:
    assert str(Shard.parse("2/8")) == "2/8" and Shard.parse("").is_whole
    with pytest.raises(InvalidInput):
        Shard(3, 2)


@pytest.mark.parametrize(
    "words",
    [("generate", "--nx", 1, "--count", 2), ("collect", "--episodes", 2, "--policy", "random")],
)
def test_a_shard_with_nothing_to_do_is_refused(
    words: tuple[object, ...], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym(*words, "--out", tmp_path / "a", "--set", "run.shard=3/3", "--workers", 1) == 2
    assert "split the run into fewer shards" in said(capfd)[0]


# Episodes.

COLLECT = (
    "collect",
    "--task",
    "unknot",
    "--nx",
    1,
    "--policy",
    "random",
    "--observation",
    "state",
    "--horizon",
    2,
    "--episodes",
    7,
    "--id",
    "knotgym/unknot-nx1/random-v0",
)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return in_parts(3, tmp_path_factory.mktemp("played") / "root", *COLLECT)


def test_shards_of_episodes_make_the_bytes_of_one_run(played: list[Path], tmp_path: Path) -> None:
    assert knotgym("dataset", "merge", *reversed(played), "--out", tmp_path / "merged") == 0
    assert knotgym(*COLLECT, "--workers", 1, "--quiet", "--out", tmp_path / "one") == 0
    merged, one = (bytes_of(tmp_path / name) for name in ("merged", "one"))
    assert merged.keys() == one.keys() and {name for name in one if merged[name] != one[name]} <= {
        "knotgym/unknot-nx1/random-v0/data/collection.json"  # holds the seconds that planning took
    }


def test_a_shard_of_episodes_verifies_and_resumes_to_itself(
    played: list[Path], capfd: pytest.CaptureFixture[str]
) -> None:
    assert [path.name for path in played] == [
        f"random-v0-shard-{number}-of-3" for number in (1, 2, 3)
    ]
    assert knotgym("dataset", "verify", played[1], "--quiet") == 0
    root, before = played[0].parents[2], bytes_of(played[0])
    assert (
        knotgym(*COLLECT, "--out", root, "--set", "run.shard=1/3", "--resume") == 0
        and bytes_of(played[0]) == before
    )
    assert "is finished already" in capfd.readouterr().out.replace("\n", " ")


@pytest.mark.parametrize(
    ("chosen", "problem"),
    [
        ((0, 2), "of 3 shards 2 is missing"),
        ((0,), "of 3 shards 2, 3 are missing"),
        ((0, 0, 1, 2), "a shard is named twice"),
    ],
)
def test_what_is_no_whole_is_not_merged(
    chosen: tuple[int, ...],
    problem: str,
    played: list[Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert (
        knotgym("dataset", "merge", *(played[k] for k in chosen), "--out", tmp_path / "merged") == 2
    )
    assert problem in said(capfd)[0] and list(tmp_path.iterdir()) == []


def test_a_spoilt_shard_is_named(
    played: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(played[1], tmp_path / "copy")
    data = bytearray((copy / "main_data.hdf5").read_bytes())
    data[len(data) // 2] ^= 1
    (copy / "main_data.hdf5").write_bytes(data)
    assert (
        knotgym("dataset", "merge", played[0], copy, played[2], "--out", tmp_path / "merged") == 2
    )
    assert (
        "main_data.hdf5 is missing or spoilt (SHA-256 differs); make shard 2/3 again"
        in said(capfd)[0]
    )


def test_shards_of_different_runs_are_not_merged(
    played: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(played[1], tmp_path / "copy")
    report = json.loads((copy / "collection.json").read_text())
    report["config"]["seed"] = 7
    (copy / "collection.json").write_text(json.dumps(report))
    assert (
        knotgym("dataset", "merge", played[0], copy, played[2], "--out", tmp_path / "merged") == 2
    )
    assert "are not shards of one run" in said(capfd)[0]
    assert knotgym("dataset", "merge", *played, tmp_path, "--out", tmp_path / "merged") == 2
    assert "only merged with each other" in said(capfd)[0]


def test_a_state_that_two_shards_made_is_kept_once(rope: Any) -> None:
    loop = rope.loop()
    assert apart(
        np.stack([loop, loop * [2, 1, 1], loop + 1.0, loop * [3, 1, 1], loop * [2, 1.001, 1]])
    ).tolist() == [True, True, False, True, False]


# Pictures.

IMAGES = ("images", "--nx", "0,1", "--count", 4, "--set", "test_share=0.25")


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return in_parts(2, tmp_path_factory.mktemp("pictured") / "table", *IMAGES)


@pytest.mark.slow  # the merged table is verified below
@with_arrow
def test_every_shard_of_pictures_verifies(pictured: list[Path]) -> None:
    assert len(pictured) == 2
    assert all(knotgym("dataset", "verify", part, "--quiet") == 0 for part in pictured)


@pytest.mark.slow
@with_arrow
def test_merged_pictures_verify_without_a_leak_or_a_duplicate(
    pictured: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    parts = pictured
    assert knotgym("dataset", "merge", *parts, "--out", tmp_path / "table") == 0
    assert knotgym("dataset", "verify", tmp_path / "table", "--quiet") == 0
    rows = list(read_rows(tmp_path / "table"))
    dropped = json.loads((tmp_path / "table" / "manifest.json").read_text())["report"][
        "near_duplicates_between_shards"
    ]
    assert len(rows) == 4 - dropped and len({row["source"]["row"] for row in rows}) == len(rows)
    points = points_of(read_table(tmp_path / "table"))
    assert all(
        (distances(points[k], points[k + 1 :]) >= NEAR).all() for k in range(len(points) - 1)
    )
    assert knotgym("dataset", "merge", *parts, "--out", tmp_path / "table") == 2
    assert "exists already" in said(capfd)[-1]


# The example for Slurm.


SLURM = Path(__file__).parents[2] / "examples" / "slurm"


def test_the_scripts_for_slurm_name_every_shard_and_merge_them_all(tmp_path: Path) -> None:
    (tmp_path / "knotgym").write_text('#!/bin/sh\necho "$@"\n')
    (tmp_path / "knotgym").chmod(0o755)
    dataset = tmp_path / "nx4"
    shards = [Path(f"{dataset}-shard-{number}-of-2") for number in (1, 2)]
    for shard in shards:
        shard.mkdir()
    task = {
        "SLURM_ARRAY_TASK_ID": "2",
        "SLURM_ARRAY_TASK_COUNT": "2",
        "SLURM_CPUS_PER_TASK": "3",
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
    }
    typed_by = {
        name: subprocess.run(
            ["bash", SLURM / name, *words],
            check=True,
            env={**os.environ, **task},
            capture_output=True,
            text=True,
        ).stdout.splitlines()
        for name, words in (("array.sh", ["collect", "--nx", "4"]), ("merge.sh", [str(dataset)]))
    }
    assert typed_by["array.sh"] == ["collect --nx 4 --shard 2/2 --workers 3 --resume --quiet"]
    assert typed_by["merge.sh"] == [
        f"dataset merge {shards[0]} {shards[1]} --out {dataset}",
        f"dataset verify {dataset} --quiet",
    ]


@pytest.mark.slow
def test_the_scripts_for_slurm_make_and_merge_a_run(tmp_path: Path) -> None:
    (tmp_path / "knotgym").write_text(f'#!/bin/sh\nexec {" ".join(typed())} "$@"\n')
    (tmp_path / "knotgym").chmod(0o755)
    for number in (1, 2):
        task = {
            "SLURM_ARRAY_TASK_ID": str(number),
            "SLURM_ARRAY_TASK_COUNT": "2",
            "SLURM_CPUS_PER_TASK": "1",
        }
        environment = {**os.environ, **task, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        words = [str(word) for word in (*COLLECT, "--out", tmp_path / "root")]
        subprocess.run(["bash", SLURM / "array.sh", *words], check=True, env=environment)
    dataset = tmp_path / "root" / "knotgym" / "unknot-nx1" / "random-v0"
    subprocess.run(
        ["bash", SLURM / "merge.sh", dataset, tmp_path / "root"], check=True, env=environment
    )
    assert (dataset / "data" / "main_data.hdf5").is_file()


@pytest.mark.parametrize("harm", ["id", "report"])
def test_reports_of_strangers_lead_nowhere(
    harm: str, played: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    copies = [shutil.copytree(one, tmp_path / "in" / str(k)) for k, one in enumerate(played)]
    for copy in copies:
        report = json.loads((copy / "collection.json").read_text())
        if harm == "id":
            report["config"]["dataset_id"] = "../../x-v0"
        else:
            report["tally"] = {"played": "many"}
        (copy / "collection.json").write_text(json.dumps(report))
    assert knotgym("dataset", "merge", *copies, "--out", tmp_path / "merged" / "a") == 2
    (line,) = said(capfd)
    assert "leads out" in line if harm == "id" else "say what no shard of ours says" in line
    assert not (tmp_path / "merged").exists() or not any((tmp_path / "merged").rglob("*.h*5"))
