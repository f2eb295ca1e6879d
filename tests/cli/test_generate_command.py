"""`knotgym generate` from end to end: what it leaves, the same bytes however it was run, and
nothing after a mistake or a kill.
"""

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import h5py
import minari
import mujoco
import numpy as np
import pytest

import knotgym as package
from knotgym.cli import main as cli
from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidFile
from knotgym.datasets.state_verification import folder_faults
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.search import new_archive
from knotgym.loaders import arrays
from knotgym.rendering.diagram import draw_diagram
from knotgym.rendering.picture import draw
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.runs import engine as run_engine
from knotgym.runs.executors import executor
from knotgym.states.near_duplicates import NEAR, distances
from knotgym.states.state_file import States, demonstrations_id, read_states
from knotgym.topology.crossings import label
from knotgym.topology.knots import knot_type
from knotgym.topology.reference_labeller import pyknotid_code

from ..conftest import SEARCH, trefoil
from ..minari_list import check_minari
from ..played import known_codes
from ..small_job import SECONDS, SETTINGS, WANTED, begun, knotgym

INSTALLED = str(Path(sys.executable).with_name("knotgym-generate"))


def bytes_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file."""
    return {
        str(path.relative_to(folder)): sha256(path) for path in folder.rglob("*") if path.is_file()
    }


def said(capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Lines on standard error."""
    return capfd.readouterr().err.splitlines()


@contextlib.contextmanager
def held(partial: Path) -> Iterator[None]:
    """Hold a partial folder as another run does."""
    partial.mkdir()
    with open(partial / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="module")
def states(curated: Path) -> States:
    states = read_states(curated / "states.h5")
    assert len(states) == 8
    return states


@pytest.fixture(scope="module")
def manifest(curated: Path) -> dict[str, Any]:
    return json.loads((curated / "manifest.json").read_text())


# What is in the folder.


def test_the_folder_holds_what_the_contract_lists(curated: Path) -> None:
    assert {path.name for path in curated.iterdir()} == {
        "states.h5",
        "minari",
        "gallery.png",
        "README.md",
        "manifest.json",
        "archive.h5",
    }


def test_nothing_stands_beside_the_folder(curated: Path) -> None:
    assert [path.name for path in curated.parent.iterdir()] == ["nx0-1"]


def test_the_manifest_lists_every_other_file_with_its_checksum(
    curated: Path, manifest: dict[str, Any]
) -> None:
    found = bytes_of(curated)
    del found["manifest.json"]
    assert manifest["files"] == found


def test_the_whole_configuration_is_written_thrice(
    manifest: dict[str, Any], states: States, curated: Path
) -> None:
    assert manifest["config"] == states.attributes["config"] and manifest["config"]["nx"] == [0, 1]
    assert '"split_by": "state"' in (curated / "README.md").read_text()


def test_versions_and_the_rope_are_written_with_the_states(states: States, rope: Rope) -> None:
    attributes = states.attributes
    assert (attributes["knotgym"], attributes["rope"], attributes["mujoco"]) == (
        package.__version__,
        rope.config.fingerprint,
        mujoco.__version__,
    )


def test_there_are_as_many_states_as_asked_for_of_as_many_codes_as_there_are(
    states: States,
) -> None:
    assert states.nx.tolist() == [0] * 4 + [1] * 4 and sorted(states.gauss_code[4:]) == [
        "1+,1-",
        "1+,1-",
        "1-,1+",
        "1-,1+",
    ]


def test_both_splits_are_there_for_every_nx(states: States) -> None:
    assert [len(states.rows(nx, split)) for nx in (0, 1) for split in ("train", "test")] == [
        2,
        2,
        2,
        2,
    ]


def test_labels_are_what_both_labellers_read(states: States) -> None:
    for points, plain, chiral in zip(
        states.points, states.gauss_code, states.gauss_code_chiral, strict=True
    ):
        code = label(points)
        assert (str(code), code.chiral) == (plain, chiral) and pyknotid_code(points) == code


def test_pictures_are_those_of_the_points(states: States) -> None:
    assert states.image is not None and all(
        np.array_equal(image, draw(points))
        for image, points in zip(states.image, states.points, strict=True)
    )


@pytest.mark.slow  # verification replays every row in test_commands
def test_every_provenance_ends_in_its_row_bit_for_bit(states: States) -> None:
    simulation = MujocoSimulation()
    for row in range(len(states)):
        simulation.lay(states.source["start_qpos"][row][None])
        for action in states.source["actions"][row, : states.source["steps"][row]]:
            assert simulation.act(action[None]).all()
        assert np.array_equal(simulation.qpos()[0], states.qpos[row]) and np.array_equal(
            simulation.points[0], states.points[row]
        )


def test_no_two_states_are_near_duplicates(states: States) -> None:
    for nx in (0, 1):
        points = states.points[states.nx == nx]
        assert all((distances(points[k], points[k + 1 :]) >= NEAR).all() for k in range(3))


def test_rows_name_their_own_trajectory(states: States) -> None:
    assert (
        states.source["dataset"].tolist()
        == [demonstrations_id(*row) for row in zip(states.nx, states.split, strict=True)]
        and len({tuple(seed) for seed in states.source["seed"]}) == 8
    )
    for nx, split in product((0, 1), ("train", "test")):
        assert states.source["trajectory"][states.rows(nx, split)].tolist() == [0, 1]


def test_every_measure_is_within_its_limit(states: States, manifest: dict[str, Any]) -> None:
    limits = manifest["config"]["limits"]
    for name, bound in limits.items():
        if name in ("excess_crossing_number", "total_curvature"):
            assert (
                states.quality[name] <= bound * (states.nx + 1 if name == "total_curvature" else 1)
            ).all(), name
        else:
            assert (states.quality[name] >= bound).all(), name


def test_the_archive_of_the_run_can_be_read(curated: Path) -> None:
    assert len(known_codes(Archive.load(curated / "archive.h5"), 1)) == 2


def test_the_gallery_shows_every_state_as_a_diagram(curated: Path, states: States) -> None:
    sheet = np.asarray(cv2.imread(str(curated / "gallery.png")))[..., ::-1]
    first = states.points[min(range(4), key=lambda row: (states.split[row] != "train", row))]
    assert sheet.shape == (234, 8 * 204, 3)
    assert np.array_equal(sheet[6:198, 6:198], draw_diagram(first))


def test_the_card_tells_states_codes_and_seed(curated: Path) -> None:
    text = (curated / "README.md").read_text()
    assert (
        text.startswith("---\nlicense: cc-by-4.0\n") and "# Rope states with 0, 1 crossings" in text
    )
    assert "| 1 | 4 | 2 | 2 |" in text and "with engine mujoco and seed 0" in text
    assert not re.search(r"^\|.*(\{|\d\.\d{5})", text, re.M)  # nothing dumped into a cell
    for part in (
        "![every state with its code](gallery.png)",
        "## Columns of states.h5",
        "## To cite",
        "```bibtex",
    ):
        assert part in text


# What can be done with it.


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_environment_resets_from_the_states(curated: Path, states: States, split: str) -> None:
    env = gymnasium.make("knotgym/Tie-v0", nx=1, split=split, states=str(curated / "states.h5"))
    goals = {str(code) for code in states.gauss_code[states.rows(1, split)]}
    for seed in range(5):
        _, info = env.reset(seed=seed)
        assert info["gauss_code"] == "" and info["goal_gauss_code"] in goals


@pytest.mark.parametrize(
    ("name", "nx", "split"),
    [
        ("knotgym/unknot-nx0/demonstrations-v0", 0, "train"),
        ("knotgym/tie-nx1/demonstrations-v0", 1, "train"),
        ("knotgym/tie-nx1/demonstrations-test-v0", 1, "test"),
    ],
)
def test_minari_loads_the_trajectories_of_one_split(
    curated: Path, states: States, monkeypatch: pytest.MonkeyPatch, name: str, nx: int, split: str
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(curated / "minari"))
    dataset = minari.load_dataset(name)
    assert dataset.total_episodes == 2
    env: Any = dataset.recover_environment().unwrapped
    assert env.config.split == split
    for row, episode in zip(states.rows(nx, split), dataset.iterate_episodes(), strict=True):
        goals = {text.decode() for text in episode.infos["goal_gauss_code"]}
        assert goals == {states.gauss_code[row]}
        steps = states.source["step"][row]
        assert len(episode.actions) == steps
        assert episode.infos["gauss_code"][-1].decode() == states.gauss_code[row]
        assert (
            episode.terminations.tolist() == [False] * (steps - 1) + [True]
            and not episode.truncations.any()
        )
        assert states.image is not None  # beside the rope its goal, the state, is shown
        assert np.array_equal(episode.observations["pixels"][-1, :, 128:], states.image[row])


@pytest.mark.slow  # and with collected ones, in tests/generate/test_collect.py
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("knotgym/unknot-nx0/demonstrations-test-v0", marks=pytest.mark.slow),
        "knotgym/tie-nx1/demonstrations-v0",
    ],
)
def test_minari_does_with_the_trajectories_all_that_it_does(
    curated: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    check_minari(curated / "minari", name, monkeypatch)


def test_the_recovered_environment_resets_from_the_states_of_the_job(
    curated: Path, states: States, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(curated / "minari"))
    env = minari.load_dataset("knotgym/tie-nx1/demonstrations-v0").recover_environment()
    for row in states.rows(1, "train"):
        _, info = env.reset(seed=0, options={"goal": int(row)})
        assert info["goal_gauss_code"] == states.gauss_code[row]
        assert np.array_equal(env.unwrapped.episodes.goal_points(0), states.points[row])


def test_loaders_take_the_folder_of_a_run_for_its_demonstrations(
    curated: Path, tmp_path: Path
) -> None:
    name = "minari/knotgym/tie-nx1/demonstrations-v0"
    shutil.copytree(curated / name, tmp_path / name)
    found = arrays(tmp_path, observation="state")
    assert np.array_equal(found["actions"], arrays(curated / name)["actions"])
    with pytest.raises(InvalidFile, match="holds several datasets; choose one of them"):
        arrays(curated)


@pytest.fixture(scope="module")
def coded(curated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder made from another's archive, its splits without a code in common."""
    out = tmp_path_factory.mktemp("coded") / "a"
    options = (
        "--nx",
        1,
        "--count",
        2,
        "--split-by",
        "code",
        "--seed",
        5,
        "--archive",
        curated / "archive.h5",
        "--workers",
        1,
        "--out",
        out,
    )
    assert knotgym("generate", *options) == 0
    return out


@pytest.mark.thorough
def test_its_archive_can_be_gone_on_from(curated: Path, coded: Path) -> None:
    before, after = (
        Archive.load(curated / "archive.h5").growth,
        Archive.load(coded / "archive.h5").growth,
    )
    assert after == before  # it knew all codes


@pytest.mark.slow  # names are compared in test_commands
def test_the_default_folder_is_named_after_nx_and_quiet_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        cli.main_generate(
            ["--settings", str(SETTINGS), "--nx", "0", "--count", "1", "--workers", "1", "--quiet"]
        )
    assert ended.value.code == 0 and (tmp_path / "knotgym-data" / "nx0" / "states.h5").is_file()
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow  # test_splits has it of the splits
def test_split_by_code_leaves_no_code_in_both(coded: Path) -> None:
    states = read_states(coded / "states.h5")
    assert sorted(states.split) == ["test", "train"] and len(set(states.gauss_code)) == 2


# The same bytes, whatever happens.


@pytest.mark.slow  # a killed run of two workers, resumed, is compared below
def test_two_workers_leave_the_same_bytes_as_one(curated: Path, tmp_path: Path) -> None:
    assert knotgym("generate", *WANTED, "--workers", 2, "--out", tmp_path / "a", "--quiet") == 0
    assert bytes_of(tmp_path / "a") == bytes_of(curated)


@pytest.mark.thorough
def test_a_killed_run_leaves_nothing_under_the_final_name(killed: Path) -> None:
    assert [path.name for path in killed.parent.iterdir()] == [".nx0-1.partial"]


@pytest.mark.thorough
def test_other_options_cannot_resume_it(killed: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = bytes_of(killed.parent)
    for options in (
        ("--nx", "0,1", "--count", 5),
        (*WANTED, "--seed", 1),
        ("--nx", 1, "--count", 4),
        (*WANTED, "--set", "split_by=code"),
    ):
        assert knotgym("generate", *options, "--workers", 1, "--out", killed, "--resume") == 2
        (line,) = said(capfd)
        assert "belongs to a different run: config." in line
    assert bytes_of(killed.parent) == before


@pytest.mark.slow  # a collection stands for it in tests/runs/test_kills.py
def test_resumed_it_ends_in_the_same_bytes_as_an_unbroken_run_and_quiet_says_nothing(
    killed: Path, curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(killed.parent / ".nx0-1.partial", tmp_path / ".nx0-1.partial")
    capfd.readouterr()
    assert (
        knotgym(
            "generate", *WANTED, "--workers", 1, "--out", tmp_path / "nx0-1", "--resume", "--quiet"
        )
        == 0
    )
    assert capfd.readouterr() == ("", "")
    assert bytes_of(tmp_path / "nx0-1") == bytes_of(curated) and [
        path.name for path in tmp_path.iterdir()
    ] == ["nx0-1"]


@pytest.mark.slow  # test_commands has it of the engine, and what a run tells
def test_with_restart_it_begins_anew_and_tells_in_plain_lines(
    killed: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(killed.parent / ".nx0-1.partial", tmp_path / ".a.partial")
    assert (
        knotgym(
            "generate",
            *("--nx", 0, "--count", 1, "--workers", 1),
            "--out",
            tmp_path / "a",
            "--restart",
        )
        == 0
    )
    assert (
        len(read_states(tmp_path / "a" / "states.h5")) == 1
        and not (tmp_path / ".a.partial").exists()
    )
    told = capfd.readouterr().out
    assert (
        "states 1 of 1; simulated actions" in told
        and "1 states of 1 codes" in told
        and "\x1b" not in told
    )


def test_a_finished_run_is_resumed_to_itself(curated: Path, tmp_path: Path) -> None:
    shutil.copytree(curated, tmp_path / "a")
    (tmp_path / ".a.partial").mkdir()  # as if killed right after the folder took its name
    assert knotgym("generate", *WANTED, "--workers", 1, "--out", tmp_path / "a", "--resume") == 0
    assert bytes_of(tmp_path / "a") == bytes_of(curated) and [
        path.name for path in tmp_path.iterdir()
    ] == ["a"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("number", "group", "workers"),
    [
        pytest.param(
            signal.SIGINT, True, 2, marks=pytest.mark.slow
        ),  # test_kills has it by default
        (signal.SIGTERM, False, 1),
    ],
)
def test_an_interrupted_run_says_one_line_and_leaves_nothing(
    tmp_path: Path, number: signal.Signals, group: bool, workers: int
) -> None:
    run = begun(tmp_path / "a", "--workers", workers, saved=False)
    (os.killpg if group else os.kill)(run.pid, number)
    _, error = run.communicate(timeout=SECONDS)
    assert run.returncode == 130
    assert (
        error == "knotgym: interrupted; no partial output is left, --resume continues from the last"
        " checkpoint\n"
    )
    # without any work done, not even the staging folder is left
    assert {path.name for path in tmp_path.iterdir()} <= {".a.partial"}


@pytest.mark.thorough
def test_an_error_in_a_worker_comes_out_as_it_is() -> None:
    with pytest.raises(ValueError, match="invalid literal for int"), executor(2) as pool:
        list(pool.map(int, ["one", "two"]))


def test_a_worker_that_dies_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    class Deadly:
        def map(self, function: object, work: Iterable[object], /) -> Iterator[object]:
            raise BrokenProcessPool

    @contextlib.contextmanager
    def deadly(workers: int, scheduler: str) -> Iterator[Deadly]:
        yield Deadly()

    monkeypatch.setattr(run_engine, "executor", deadly)
    assert knotgym("generate", "--nx", 0, "--count", 1, "--out", tmp_path / "a") == 1
    assert said(capfd) == [
        "knotgym: a worker died, perhaps out of memory; --resume continues from the last checkpoint"
    ]


# What is refused.


def test_a_second_run_into_the_same_folder_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with held(tmp_path / ".a.partial"):
        for more in ((), ("--resume",)):
            assert knotgym("generate", *WANTED, "--workers", 1, "--out", tmp_path / "a", *more) == 2
            assert said(capfd) == ["knotgym: another run is writing a now"]
        assert [path.name for path in tmp_path.rglob("*")] == [".a.partial", "lock"]


def test_a_folder_that_is_there_is_not_touched(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine.txt").write_text("mine")
    for more in ((), ("--resume",)):
        assert knotgym("generate", *WANTED, "--out", tmp_path / "a", *more) == 2
        assert said(capfd) == [
            f"knotgym: {tmp_path / 'a'} exists already; --overwrite replaces it, or choose another"
            " --out"
        ]
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "mine.txt"]


@pytest.fixture
def mistaken(tmp_path: Path) -> Path:
    """A folder with files that are no input."""
    folder = tmp_path / "input"
    folder.mkdir()
    np.savetxt(folder / "three.txt", np.eye(3))
    np.savetxt(folder / "open.txt", trefoil()[:200])
    (folder / "empty.npy").touch()
    (folder / "text.h5").write_text("not HDF5")
    with h5py.File(folder / "foreign.h5", "w") as file:
        file["x"] = 1.0
    new_archive(SEARCH, Rope().from_curve(trefoil())).save(folder / "knotted.h5")
    return folder


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("--nx -1", "--nx takes whole numbers such as 3, 2,3 or 0-4, got '-1'"),
        ("--nx=-1", "--nx takes whole numbers such as 3, 2,3 or 0-4, got '-1'"),
        ("--nx 12", "from 0 to 11, got 12"),
        ("--beads 40 --no-demonstrations", "beads must be from 50 to 1000, got 40"),
        ("--beads 200", "demonstrations are for a rope of 100 beads, got 200; leave them out"),
        ("--beads 200 --source random-walk", "--beads needs --source drawing"),
        ("--codes hard-unknots --nx 4", "hard-unknots.txt contains no code with nx 4"),
        (
            "--nx 7",
            "limited to 6 crossings, got nx 7; --no-demonstrations makes states without them",
        ),
        ("--nx 4-2", "got '4-2'"),
        ("--nx 0-99999999999", "got '0-99999999999'"),
        ("--nx three", "got 'three'"),
        ("--nx 2,", "got '2,'"),
        ("--count 0", "count must be a whole number of at least 1, got 0"),
        ("--count many", "--count"),
        ("--every-code -2", "every_code must be a whole number of at least 0, got -2"),
        ("--attempts 0", "attempts must be a whole number of at least 1, got 0"),
        ("--cycles -1", "cycles must be a whole number of at least 0, got -1"),
        ("--seed -1", "seed must be a whole number of at least 0, got -1"),
        ("--workers -1", "workers must be at least 0, got -1"),
        ("--colour red", "No such option: --colour"),
        ("leftover", "leftover"),
        ("--split-by row", 'split_by must be "state" or "code", got \'row\''),
        ("--source play", "--source takes drawing or random-walk, got 'play'"),
        ("--knot 9_50", "no knot '9_50'; there are 0_1, the prime knots"),
        ("--archive {}/knotted.h5 --no-demonstrations", "remove --no-demonstrations"),
        ("--knot 3_1 --nx 2", "no diagram of 3_1 has 2 crossings"),
        ("--knot {}/three.txt", "a closed rope needs at least 4 different points, got 3"),
        ("--knot {}/open.txt", "the curve isn't closed"),
        ("--knot {}/empty.npy", "empty.npy holds no curve"),
        ("--archive {}/absent.h5", "no archive at"),
        ("--archive {}/text.h5", "text.h5 isn't a whole archive"),
        (
            "--archive {}/foreign.h5",
            "foreign.h5 has format 'none' version none; this version reads 'knotgym-archive'",
        ),
        ("--archive {}/knotted.h5", "start from another curve"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(
    mistaken: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], options: str, problem: str
) -> None:
    words = [
        "--out",
        str(tmp_path / "made" / "a"),
        "--workers",
        "1",
        *options.format(mistaken).split(),
    ]
    assert knotgym("generate", *words) == 2
    (line,) = said(capfd)
    assert line.startswith("knotgym: ") and problem in line
    assert [path.name for path in tmp_path.iterdir()] == ["input"]


def test_no_command_shows_the_help(capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym() == 2
    shown = capfd.readouterr()
    assert "generate" in shown.out + shown.err and "knotgym: " not in shown.err


def test_too_few_attempts_are_a_failure_that_can_be_resumed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    hard = json.loads(SETTINGS.read_text())
    hard["limits"] = {"clearance": 1000.0}  # millimetres: no rope has as much
    (tmp_path / "hard.json").write_text(json.dumps(hard))
    words = ("--nx", 0, "--count", 1, "--set", "attempts=1", "--settings", tmp_path / "hard.json")
    out = tmp_path / "runs" / "a"
    assert knotgym("generate", *words, "--workers", 1, "--quiet", "--out", out) == 1
    (line,) = said(capfd)
    assert line.startswith(
        "knotgym: missing states: 1 with nx = 0; give --resume with more --attempts"
    )
    assert [path.name for path in out.parent.iterdir()] == [".a.partial"]


def test_a_fault_of_our_own_is_not_called_the_users_mistake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def faulty(folder: Path) -> bool:
        raise ValueError("shapes (3,) and (4,) differ")

    monkeypatch.setattr(run_engine, "request_of", faulty)
    (tmp_path / "a").mkdir()
    words = ("generate", "--nx", 0, "--count", 1, "--out", tmp_path / "a", "--resume")
    assert knotgym(*words) == 1
    lines = said(capfd)
    assert lines[0] == "Traceback (most recent call last):"
    assert "ValueError: shapes (3,) and (4,) differ" in lines
    assert "a bug in knotgym" in lines[-1] and "issue tracker" in lines[-1]


def test_an_interruption_inside_a_compiled_function_is_no_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def compiled(folder: Path) -> bool:
        # what numba makes of it
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(run_engine, "request_of", compiled)
    (tmp_path / "a").mkdir()
    words = ("generate", "--nx", 0, "--count", 1, "--out", tmp_path / "a", "--resume")
    assert knotgym(*words) == 130
    (line,) = said(capfd)
    assert line.startswith("knotgym: interrupted; no partial output is left, --resume")


# The whole job, as large as a user's.


@pytest.mark.slow
def test_a_trefoil_is_made_and_certified(tmp_path: Path) -> None:
    words = [
        INSTALLED,
        "--knot",
        "3_1",
        "--nx",
        "3",
        "--count",
        "2",
        "--workers",
        "1",
        "--out",
        str(tmp_path / "a"),
    ]
    run = subprocess.run(words, capture_output=True, text=True)
    assert run.returncode == 0 and run.stderr == ""
    states = read_states(tmp_path / "a" / "states.h5")
    assert len(states) == 2 and set(states.knot) == {"3_1"} and set(states.nx) == {3}
    assert {knot_type(label(points)) for points in states.points} == {"3_1"}
    assert list(folder_faults(tmp_path / "a")) == []


@pytest.mark.slow
def test_the_command_as_installed_makes_a_folder(tmp_path: Path) -> None:
    words = [
        INSTALLED,
        "--nx",
        "0-1",
        "--count",
        "4",
        "--workers",
        "2",
        "--out",
        str(tmp_path / "a"),
    ]
    run = subprocess.run(words, capture_output=True, text=True)
    assert run.returncode == 0 and run.stderr == "" and list(folder_faults(tmp_path / "a")) == []
