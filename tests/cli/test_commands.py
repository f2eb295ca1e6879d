"""The first hour at a terminal: what every command says, and when; names that tell sets apart; what
is tried before hours of work. Under a pseudo-terminal where a person would look on.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
import json
import os
import pty
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import minari
import pytest
from rich.console import Console

import knotgym as package
from knotgym import __version__
from knotgym.cli import main as cli
from knotgym.cli.options import default_folder
from knotgym.cli.summaries import _in_words
from knotgym.common.errors import Occupied
from knotgym.control.policy_config import PolicyConfig
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import distinct_id
from knotgym.generate.episodes.collect_config import CollectConfig
from knotgym.generate.episodes.results import Result, reference_lines, show
from knotgym.rope.engines import warn_of_compilation
from knotgym.runs.compilation import compile_first
from knotgym.runs.engine import CHECKPOINT, Batch, Recipe, run
from knotgym.runs.executors import InProcess
from knotgym.runs.progress import Progress, Status, duration, tell_if_long
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import staging_folder

from ..small_job import knotgym, typed
from .test_generate_command import held

ROOT = Path(__file__).parents[2]
ID = "knotgym/tie-nx1/demonstrations-v0"
WAYS = f"minari/{ID}"
COMMANDS = {
    "generate": ("generate", "--nx", 0, "--count", 1, "--workers", 1, "--out", "{}/a"),
    "collect": (
        *("collect", "--task", "unknot", "--nx", 1, "--policy", "random", "--episodes", 1),
        *("--set", "task.horizon=2", "--observation", "state", "--workers", 1, "--out", "{}/b"),
    ),
    "images": ("images", "--nx", 0, "--count", 2, "--set", "test_nx=none", "--workers", 1)
    + ("--set", "test_share=0", "--set", "code_share=0", "--out", "{}/c"),
    "evaluate": ("evaluate", "--episodes", 1, "--set", "task.horizon=2", "--workers", 1),
    "verify": ("dataset", "verify", "{curated}/states.h5"),
    "merge": ("dataset", "merge", "{curated}", "--out", "{}/m.h5"),
    "export": ("dataset", "export", "{curated}/" + WAYS, "--out", "{}/e.h5"),
}
_END = b"the end of it"
CLEARED = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")


def said(capfd: pytest.CaptureFixture[str]) -> list[str]:
    return capfd.readouterr().err.splitlines()


@contextmanager
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], str]]:
    """A pseudo-terminal as standard output; gives all that was written there, and closes it."""
    master, slave = pty.openpty()
    seen, whole = bytearray(), threading.Event()

    def read() -> None:
        while not whole.is_set():
            seen.extend(os.read(master, 4096))
            if _END in seen:
                whole.set()

    threading.Thread(target=read, daemon=True).start()
    output = os.fdopen(slave, "w", buffering=1, encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")

    def shown() -> str:
        output.write(_END.decode())
        output.flush()
        assert whole.wait(60)
        return bytes(seen).decode()

    yield shown
    output.close()
    os.close(master)


# Progress.


@pytest.mark.parametrize(
    "command",
    [
        # all tell alike
        pytest.param(name, marks=pytest.mark.slow) if name not in ("generate", "evaluate") else name
        for name in COMMANDS
    ],
)
def test_a_terminal_is_told_from_the_first_moment_and_at_the_end(
    command: str, curated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [str(word).format(tmp_path, curated=curated) for word in COMMANDS[command]]
    with monkeypatch.context() as patch, terminal(patch) as shown:
        assert knotgym(*words) == 0
        told = CLEARED.sub("", shown())
    assert "[bold]" not in told and told.startswith(("starting", "\rstarting")), told[:80]
    result = {
        "generate": "1 states of 1 codes",
        "collect": "1 episodes, ",
        "images": "2 pictures",
        "evaluate": "return",
        "verify": "8 Gauss codes: no faults",
        "merge": "m.h5: 8 states",
        "export": "2 episodes, ",
    }[command]
    assert result in told.partition("starting")[2]


@pytest.mark.parametrize(
    "command",
    [
        name if name == "evaluate" else pytest.param(name, marks=pytest.mark.slow)
        for name in COMMANDS
    ],
)
def test_the_first_line_costs_less_than_two_seconds(
    command: str, curated: Path, tmp_path: Path
) -> None:
    words = [str(word).format(tmp_path, curated=curated) for word in COMMANDS[command]]
    master, slave = pty.openpty()
    run = subprocess.Popen(
        typed(*words), stdout=slave, stderr=slave, env={**os.environ, "TERM": "xterm"}
    )
    assert os.read(master, 1)
    run.kill()
    _, _, used = os.wait4(run.pid, 0)
    run.returncode = -9  # waited for just now
    os.close(slave)
    os.close(master)
    # computing, for the time by the clock depends on what else the machine does
    assert used.ru_utime + used.ru_stime < 2


FIRST_LINES = """
import os, sys
from typer.testing import CliRunner
from knotgym.cli.main import app
from knotgym.runs.progress import Progress

HEAVY = ("mujoco", "numba", "cv2", "h5py", "minari", "torch", "pyarrow")
early = {}

def enter(progress):
    early[command] = [name for name in HEAVY if name in sys.modules]
    raise KeyboardInterrupt

Progress.__enter__ = enter
for command in sys.argv[1:]:
    CliRunner().invoke(app, command.split())
print(early)
"""


def test_the_first_line_comes_before_anything_heavy_is_imported() -> None:
    commands = [
        *("generate", "collect", "suite", "evaluate", "images", "prompt --model x"),
        *(f"dataset {name} x" for name in ("show", "verify", "gallery", "replay", "page")),
        *("dataset merge x --out y", "dataset export x --out y"),
    ]
    if all(importlib.util.find_spec(name) for name in ("torch", "safetensors")):
        commands.append("train --out y --data x")
    run = subprocess.run(
        [sys.executable, "-c", FIRST_LINES, *commands], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == str({command: [] for command in commands})


@pytest.mark.thorough
def test_it_ticks_while_a_single_piece_of_work_goes_on() -> None:
    written = io.StringIO()
    ticked = threading.Event()
    clock = iter(range(10**6))

    class Watched(io.StringIO):
        def write(self, text: str) -> int:
            done = written.write(text)
            if "searching 0 of 1" in CLEARED.sub("", text).replace("  ", " "):
                seen.append(text)
            if len(seen) > 3:
                ticked.set()
            return done

    seen: list[str] = []
    console = Console(file=Watched(), force_terminal=True, width=80)
    with Progress(console=console, clock=lambda: float(next(clock))) as progress:
        progress.stage("searching", 0, 1)
        batch = Batch(lambda unit: ticked.wait(60), [0], lambda unit, result: None, "searching")
        list(batch.follow(InProcess()))
    assert ticked.is_set() and len(set(seen)) > 3  # each with another time


def test_a_first_run_says_that_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = SimpleNamespace(stats=SimpleNamespace(cache_path=tmp_path))  # nothing compiled there
    monkeypatch.setattr("knotgym.topology.crossing_kernel.scan", kernel)
    stages: list[str] = []
    monkeypatch.setattr(Progress, "stage", lambda _, name: stages.append(name))
    compile_first(Progress(quiet=True))
    assert stages == ["compiling, only on the first run", "starting"]


def test_a_first_environment_says_once_that_it_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kernel = SimpleNamespace(stats=SimpleNamespace(cache_path=tmp_path))
    monkeypatch.setattr("knotgym.topology.crossing_kernel.scan", kernel)
    monkeypatch.setattr("knotgym.rope.engines._warned", set())
    for _ in range(2):
        warn_of_compilation("mujoco")
    assert [one.getMessage() for one in caplog.records] == [
        "compiling, in the first run only; `knotgym compile` does it beforehand"
    ]


@pytest.mark.thorough
def test_the_demo_writes_an_observation_a_film_and_a_page(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("demo", "--out", tmp_path / "demo") == 0
    told = capfd.readouterr().out
    for name in ("reset.png", "expert.mp4", "page.html"):
        assert (tmp_path / "demo" / name).stat().st_size > 1000 and f"demo/{name}:" in told
    assert "reaches the goal in 2 of 2 episodes" in told
    assert knotgym("demo", "--out", tmp_path / "demo") == 2


@pytest.mark.slow
def test_everything_can_be_compiled_beforehand(capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym("compile") == 0
    assert "compiled; the machine code is kept in" in capfd.readouterr().out


def test_a_collection_ends_with_the_lines_that_load_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = "--task unknot --nx 1 --policy random --episodes 1 --horizon 2 --workers 1"
    assert knotgym("collect", *words.split(), "--out", tmp_path) == 0
    minari_line, arrays_line = capfd.readouterr().out.splitlines()[-2:]
    call, _, setting = minari_line.strip().partition("  # with ")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(*setting.split("="))
        assert len(eval(call, {"minari": minari})) == 1
    importlib.import_module("knotgym.loaders")
    assert len(eval(arrays_line.strip(), {"knotgym": package})["actions"]) == 2


def test_help_keeps_its_square_brackets(capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym("images", "--help") == 0
    assert "pip install '.[huggingface]'" in capfd.readouterr().out


def test_results_stand_beside_those_of_random_and_expert() -> None:
    assert reference_lines([result("random", task="tie", nx=2)]) == [
        "for reference, mean return of tie nx 2: random -3.71, expert 5.00 (64 episodes, test"
        " split, readable states)"
    ]
    assert reference_lines([result("random", task="tie", nx=9)]) == []


def test_a_terminal_is_told_while_printed_words_go_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch, terminal(patch) as shown:
        # as pyknotid's do, while it is imported
        with Progress() as progress, redirect_stdout(io.StringIO()) as kept:
            progress.say("told")
        assert "told" in shown() and not kept.getvalue()


def shown(even: bool, *done: int) -> str:
    """What plain lines say of a run of ten things, looked at every 20 s."""
    written, now = io.StringIO(), iter(range(0, 10**6, 20))
    progress = Progress(console=Console(file=written, width=200), clock=lambda: float(next(now)))
    with progress:
        for count in done:
            progress.show(lambda count=count: Status(count, 10, "things", even=even))  # type: ignore[misc]
    return written.getvalue()


def test_counters_never_pass_what_was_asked_for() -> None:
    told = shown(False, 0, 12)
    assert "things 10 of 10; beyond the request 2" in told and "12 of" not in told


def test_a_plain_run_says_something_before_it_imports_anything(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Progress():
        assert capsys.readouterr().out == "    0 s  starting\n"


def test_the_time_left_is_told_where_it_can_be() -> None:
    assert "time left, about" in shown(True, 0, 2)
    assert "time left" not in shown(False, 0, 2) and "time left" not in shown(True, 0, 0)


def test_a_time_left_grows_while_nothing_happens() -> None:
    first, second = re.findall(r"about (\d+) s", shown(True, 0, 8, 8))
    assert int(second) > int(first)


def test_the_time_left_goes_by_the_share_of_the_work_where_it_is_known() -> None:
    times, written = iter([0.0, 0.0, 20.0, 20.0]), io.StringIO()
    progress = Progress(console=Console(file=written, width=200), clock=lambda: next(times))
    progress.show(lambda: Status(0, 40, "states", share=0.0))
    progress.show(lambda: Status(0, 40, "states", share=0.25))
    assert "20 s  states 0 of 40; time left, about 60 s" in written.getvalue()


def test_a_run_says_a_line_before_it_imports_anything_heavy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("knotgym.generate.states.state_recipe.run", lambda *_: None)
    assert knotgym("generate", "--count", 1, "--out", tmp_path / "a") == 0
    assert re.match(r"\s+0 s  starting\n", capfd.readouterr().out)


def test_a_long_run_whose_output_is_a_result_tells_on_standard_error(
    capfd: pytest.CaptureFixture[str],
) -> None:
    times = iter((0.0, 1.0, 5.0, 12.0, 13.0))
    progress = Progress(lines=False, clock=lambda: next(times))
    for done in range(4):
        progress.show(partial(Status, done, 4, "episodes"))
    assert capfd.readouterr() == ("", "   12 s  episodes 2 of 4\n")


@pytest.mark.parametrize(
    ("seconds", "told"), [(3000, ""), (9e6, "about 52 days"), (2e9, "32 years")]
)
def test_a_job_without_end_says_so_before_it_begins(seconds: float, told: str) -> None:
    written = io.StringIO()
    tell_if_long(Progress(console=Console(file=written, width=200)), seconds, 2)
    assert told in written.getvalue() and bool(told) == bool(written.getvalue())
    assert duration(59) == "59 s"


def test_a_million_states_are_said_to_take_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("knotgym.generate.states.state_recipe.run", lambda *_: None)
    assert knotgym("generate", "--count", 1000000, "--workers", 2, "--out", tmp_path / "a") == 0
    assert "this would take about 17 days with 2 workers" in capfd.readouterr().out


# Before hours of work.


@pytest.mark.parametrize(
    "words",
    [
        ("generate", "--nx", 0, "--count", 1),
        ("collect", "--episodes", 1),
        ("images", "--nx", 0, "--count", 2),
        ("evaluate", "--episodes", 1),
        *(("dataset", name, "{}/x") for name in ("merge", "export", "page", "replay")),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_at_once(
    words: tuple[object, ...], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    typed = [str(word).format(tmp_path) for word in words]
    assert knotgym(*typed, "--out", tmp_path / "file" / "a") == 2
    (line,) = said(capfd)
    assert "can't be written" in line and [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("generate", "--nx", "1,1"), "each number once, got '1,1'"),
        (("collect", "--policy", "mixed", "--set", "policy.shares=inf,1,1,1"), "4 finite numbers"),
        (("evaluate", "--filmed", -1), "filmed must be a whole number of at least 0, got -1"),
        (("generate", "--nx", 0, "--out", "x" * 300), "can't be written: File name too long"),
        (("generate", "--nx", 0, "--out", "/dev/null/x"), "/dev/null/x can't be written"),
        (("dataset", "verify", "/dev/null/x"), "no such file: /dev/null/x"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    words: tuple[object, ...],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert knotgym(*words) == 2
    (line,) = said(capfd)
    assert told in line and not list(tmp_path.iterdir())


class Empty(Recipe):
    """A recipe of nothing."""

    engine = "mujoco"

    def request(self) -> dict[str, Any]:
        return {"config": {}, "source": None}

    def begin(self) -> None: ...

    def save(self, folder: Path) -> None: ...

    def load(self, folder: Path) -> bool:
        return False

    def batches(self, folder: Path) -> Iterator[Batch]:
        yield CHECKPOINT

    def status(self) -> Status:
        return Status(0, 0, "things")

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        folder.mkdir()
        (folder / "manifest.json").write_text(json.dumps(request))
        return folder

    def summary(self) -> str:
        return "nothing"


def test_resume_on_nothing_says_so_and_a_run_over_what_is_left_needs_a_word(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out, options = tmp_path / "a", RunOptions(workers=1)
    run(Empty(), out, replace(options, resume=True))
    assert "there is nothing to resume, starting from the beginning" in capfd.readouterr().out
    staging_folder(out).mkdir()
    out.joinpath("manifest.json").rename(staging_folder(out) / "request.json")
    out.rmdir()
    with pytest.raises(Occupied, match="--resume continues it, --restart deletes it"):
        run(Empty(), out, options)
    run(Empty(), out, replace(options, restart=True))
    assert list(tmp_path.iterdir()) == [out]  # and nothing hidden


def test_a_run_begins_over_a_lock_that_nobody_holds(tmp_path: Path) -> None:
    out = tmp_path / "a"
    with held(staging_folder(out)):
        pass
    assert (staging_folder(out) / "lock").is_file()  # left by a process that is gone
    run(Empty(), out, RunOptions(workers=1, quiet=True))
    assert list(tmp_path.iterdir()) == [out]


# Names.


def test_default_folders_tell_runs_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    monkeypatch.setattr(
        "knotgym.generate.states.state_recipe.run",
        lambda recipe, out, *_: made.append(str(out)),
    )
    for words in (
        "--nx 3 --count 40",
        "--nx 3 --knot 3_1",
        "--nx 3 --seed 1",
        "--nx 3 --split-by code",
        "--nx 3 --every-code 1",
    ):
        assert knotgym("generate", *words.split(), "--quiet") == 0
    assert made == [
        f"knotgym-data/{name}"
        for name in ("nx3", "nx3-3_1", "nx3-seed1", "nx3-by-code", "nx3-every1")
    ]
    assert str(default_folder("nx0-4")) == "knotgym-data/nx0-4"


def test_default_ids_tell_collections_apart(states_path: str) -> None:
    plain = TaskConfig(task="tie", nx=3, observation="both")
    expert = PolicyConfig(policy="expert")
    usual = CollectConfig(task=plain, policy=expert)
    assert distinct_id(usual) == "knotgym/tie-nx3/expert-v0"
    ids = {
        distinct_id(CollectConfig(task=task, policy=policy, seed=seed))
        for task, policy, seed in (
            (plain, expert, 0),
            (plain, expert, 1),
            (TaskConfig(task="tie", nx=3, horizon=9), expert, 0),
            (TaskConfig(task="tie", nx=3, split="test"), expert, 0),
            (replace(plain, observation="state"), expert, 0),
            (replace(plain, observation="pixels"), expert, 0),
            (replace(plain, image_size=64), expert, 0),
            (TaskConfig(task="tie", nx=3, states="random-walk"), expert, 0),
            (TaskConfig(task="tie", nx=3, states=states_path), expert, 0),
            (plain, PolicyConfig(policy="noisy", noise=0.5), 0),
        )
    }
    ids.add(distinct_id(replace(usual, keep_failed=False)))
    assert len(ids) == 11
    assert all(re.fullmatch(r"knotgym/tie-nx3/[-\w]+-v0", one) for one in ids)


def test_several_nx_are_collected_one_after_the_other(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = "--task unknot --nx 1,2 --policy random --episodes 1 --observation state --workers 1"
    assert knotgym("collect", *words.split(), "--quiet", "--out", tmp_path) == 0
    found = sorted(path.parent.name for path in tmp_path.glob("knotgym/*/random-state-v0"))
    assert found == ["unknot-nx1", "unknot-nx2"]
    assert knotgym("collect", *words.split(), "--id", "a/b-v0", "--out", tmp_path) == 2
    assert "--id names one dataset" in said(capfd)[0]


# Help.


def test_flags_have_no_type_and_options_stand_in_groups(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in (["-h"], ["collect", "--help"], ["evaluate", "-h"], ["dataset", "merge", "-h"]):
        assert knotgym(*words) == 0
        told = capfd.readouterr().out
        assert "bool" not in told and "Examples" in told
        assert all(len(line) <= 80 for line in told.splitlines())
        if words[0] == "collect":
            assert all(group in told for group in ("The environment", "Who acts", "How it is run"))
        if words[0] == "evaluate":
            assert "--image-size" in told


def test_usage_lines_say_what_can_be_typed(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("signal.signal", lambda *_: None)
    with pytest.raises(SystemExit):
        cli.main_generate(["--help"])
    assert "Usage: knotgym-generate [OPTIONS]" in capfd.readouterr().out


def test_the_version_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym("--version") == 0 and capfd.readouterr().out.startswith("knotgym ")


# Tables.


def result(policy: str, **settings: Any) -> Result:
    fields: dict[str, Any] = {
        **{
            "task": "convert",
            "nx": 3,
            "split": "train",
            "action": "pull",
            "episodes": 256,
            "successes": 256,
        },
        **{"success_rate": 1.0, "low": 0.985, "high": 1.0, "steps": 12.3, "mean_return": 5.0},
        **{"planned_actions": 0.0, "planning_seconds": 0.0, "simulation_failures": 0},
        **{"start_states": "own", "goal_states": "own", "outcomes": {}},
    }
    return Result(policy=policy, **{**fields, **settings})


def test_results_fit_eighty_columns_heads_whole() -> None:
    written = io.StringIO()
    show(
        [
            result("noisy", planned_actions=512.0, planning_seconds=1.25),
            result("my_package.policies:Recurrent"),
        ],
        Console(file=written, width=80),
    )
    told = written.getvalue()
    head = told.splitlines()[1]
    for word in ("policy", "task", "split", "nx", "success", "95 % interval", "steps", "return"):
        assert word in head
    assert "98.5 to 100.0 %" in told and "…" not in told and "nan" not in told
    assert all(len(line) <= 80 for line in told.splitlines())
    assert "planned with 512 actions, 1.25 s an episode" in told


def test_columns_without_a_number_are_gone() -> None:
    written = io.StringIO()
    show([result("random", steps=None)], Console(file=written, width=80))
    assert "steps" not in written.getvalue() and "planned" not in written.getvalue()


@pytest.mark.parametrize("name", ["", "minari", WAYS])
def test_what_show_prints_fits_a_pipe(
    curated: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    assert knotgym("dataset", "show", curated / name) == 0
    lines = [line for line in capfd.readouterr().out.splitlines() if str(curated) not in line]
    assert lines and all("{" not in line and "…" not in line for line in lines)
    tables = [line for line in lines if " drawings or walks" not in line and "; " not in line]
    assert max(map(len, tables)) <= 100


def test_numbers_and_dicts_are_told_in_words() -> None:
    assert _in_words(6675.247201946472) == "6675"
    assert _in_words({"a": 1, "b": {"c": 0.5}}) == "a 1, b c 0.5" and _in_words(None) == ""


# Success says something; one folder, one thing.


@pytest.mark.slow  # every check of it is tried in tests/datasets/test_state_verification.py
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("", "8 Gauss codes, 8 demonstrations, "),
        pytest.param(WAYS, "2 episodes, ", marks=pytest.mark.slow),  # of the eight above
        # above, verify tells a terminal the same
        pytest.param("states.h5", "8 Gauss codes: no faults", marks=pytest.mark.slow),
    ],
)
def test_verify_takes_all_that_a_run_made_and_says_what_it_checked(
    curated: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    name: str,
    told: str,
) -> None:
    counted: set[tuple[Any, ...]] = set()
    monkeypatch.setattr(Progress, "stage", lambda _, *said: counted.add(said))
    assert knotgym("dataset", "verify", curated / name) == 0
    last = capfd.readouterr().out.splitlines()[-1]
    assert told in last and last.endswith("no faults")
    if not name:
        assert "checksums" in last
        assert {("states", 7, 8), ("episodes", 1, 2)} <= counted
        acted = {said[1:] for said in counted if said[0] == "steps replayed"}
        assert any(0 < done < total for done, total in acted)


@pytest.mark.parametrize(
    "name", ["", "minari", WAYS, "states.h5", "knotgym/tie-nx1/demonstrations-v0"]
)
def test_gallery_draws_whatever_it_is_given(
    curated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    name: str,
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(curated / "minari"))
    source = name if name.startswith("knotgym/") else curated / name
    assert knotgym("dataset", "gallery", source, "--out", tmp_path / "g.png") == 0
    count = {"": "8 states", "states.h5": "8 states", "minari": "8 episodes"}.get(
        name, "2 episodes"
    )
    assert f"g.png: {count}" in capfd.readouterr().out and (tmp_path / "g.png").is_file()


def test_export_of_a_run_writes_a_file_for_each_dataset(
    curated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    counted: set[tuple[Any, ...]] = set()
    monkeypatch.setattr(Progress, "stage", lambda _, *said: counted.add(said))
    assert knotgym("dataset", "export", curated, "--out", tmp_path / "e") == 0
    assert ("episodes", 1, 2) in counted
    assert "8 episodes in 4 files" in capfd.readouterr().out
    assert sorted(path.name for path in (tmp_path / "e").iterdir()) == [
        "tie-nx1-demonstrations-test-v0.h5",
        "tie-nx1-demonstrations-v0.h5",
        "unknot-nx0-demonstrations-test-v0.h5",
        "unknot-nx0-demonstrations-v0.h5",
    ]


@pytest.mark.thorough
def test_a_replay_says_that_it_is_the_same_bit_for_bit(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "replay", curated, "--row", 5, "--out", tmp_path / "a.gif") == 0
    told = capfd.readouterr().out
    assert re.search(r"a\.gif: bit for bit the same, \d+ steps", told)


@pytest.mark.parametrize(
    "command", ["show", "verify", "gallery", "export", "replay", "merge", "page"]
)
def test_a_path_that_is_not_there_is_no_such_file(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], command: str
) -> None:
    more = () if command in ("show", "verify") else ("--out", tmp_path / "a.gif")
    assert knotgym("dataset", command, tmp_path / "absent", *more) == 2
    (line,) = said(capfd)
    assert f"no such file: {tmp_path / 'absent'}" in line and list(tmp_path.iterdir()) == []


@pytest.mark.skipif("+" in __version__, reason="a checkout that isn't installed")
def test_a_dataset_requires_this_distribution_not_the_published_one(curated: Path) -> None:
    told = json.loads((curated / WAYS / "data/metadata.json").read_text(encoding="utf-8"))
    assert f"knotgym>={__version__}" in told["requirements"] and int(__version__.split(".")[0]) >= 1
    assert " " not in told["observation_space"]


# The links at the top of a checkout.


@pytest.mark.skipif(not (ROOT / "datasets").is_symlink(), reason="a checkout without links")
@pytest.mark.parametrize("name", ["datasets", "generate", "loaders"])
def test_a_link_is_not_imported_by_its_bare_name(name: str) -> None:
    run = subprocess.run(
        [sys.executable, "-c", f"import {name}"], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 1
    assert f"import knotgym.{name}" in run.stderr.splitlines()[-1]


def test_no_memory_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(cli, "_built", lambda _: full)
    assert knotgym("dataset", "show", "x") == 1
    assert capfd.readouterr().err.startswith("knotgym: out of memory, here or in a worker")


@pytest.mark.parametrize(
    ("words", "goes_on"),
    [
        (("dataset", "show", "readable"), ""),
        (("evaluate",), ", --resume continues from the last checkpoint"),
    ],
)
def test_an_interruption_promises_to_go_on_only_where_that_can_be(
    words: tuple[str, ...],
    goes_on: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("knotgym.cli.inspection.show", stopped)
    monkeypatch.setattr("knotgym.generate.episodes.evaluate.run", stopped)
    assert knotgym(*words) == 130
    assert said(capfd) == [f"knotgym: interrupted; no partial output is left{goes_on}"]
