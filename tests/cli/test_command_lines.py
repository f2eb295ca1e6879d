"""What is typed becomes configurations, validated once; a mistake is one line with status 2."""

import json
import os
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import pytest
from pytest_types import Capture, Patch

import knotgym as knotgym_package
from knotgym.cli.options import numbers
from knotgym.common import InvalidInput
from knotgym.states import shipped

from ..fresh_interpreter import python
from ..small_job import knotgym


@pytest.fixture
def configs(monkeypatch: Patch) -> list[Any]:
    """The configurations that `evaluate` was run with, instead of running it."""
    found: list[Any] = []
    monkeypatch.setattr(
        "knotgym.generate.evaluate", lambda config, options, **_: found.append((config, options))
    )
    return found


@pytest.fixture
def here(tmp_path: Path, monkeypatch: Patch) -> dict[str, str]:
    """What lines name."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    os.mkfifo(folder / "fifo")
    (folder / "text").write_text("neither JSON nor a table\n", encoding="utf-8")
    (folder / "twice.json").write_text('{"seed": 1, "seed": 2}', encoding="utf-8")
    (folder / "trefoil").write_text("4 6 2", encoding="utf-8")
    names = ("fifo", "trefoil", "text", "twice.json", "new")
    return {**{name: str(folder / name) for name in names}, "states": str(shipped("hard-unknots"))}


def test_what_is_typed_beats_a_setting_and_that_a_file(configs: list[Any], tmp_path: Path) -> None:
    toml, as_json = tmp_path / "a.toml", tmp_path / "a.json"
    toml.write_text("episodes = 3\nseed = 4\n[task]\nhorizon = 9\nhold = 2\n[run]\nworkers = 2\n")
    task = {"horizon": 9, "hold": 2}
    as_json.write_text(json.dumps({"episodes": 3, "seed": 4, "task": task, "run": {"workers": 2}}))
    for file in (toml, as_json):
        line = ("--settings", file, "--set", "task.horizon=7", "--set", "seed=5", "--seed", 6)
        assert knotgym("evaluate", *line, "--quiet") == 0
    assert configs[0] == configs[1]
    config, options = configs[0]
    assert (config.episodes, config.seed, options.workers, options.quiet) == (3, 6, 2, True)
    assert (config.task.horizon, config.task.hold) == (7, 2)
    assert config.task.observation == "state"  # the default of evaluate, not of an environment


def test_settings_are_read_by_the_type_of_their_field(configs: list[Any]) -> None:
    words = ("task.depth=true", "task.views=top,left", "task.tow_limit=0.04", "task.max_goals=none")
    assert knotgym("evaluate", *(word for one in words for word in ("--set", one))) == 0
    task = configs[0][0].task
    assert (task.depth, task.views, task.tow_limit) == (True, ("top", "left"), 0.04)
    assert task.max_goals is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [("3", (3,)), ("2,3", (2, 3)), ("0-4", (0, 1, 2, 3, 4)), ("0-1,3", (0, 1, 3))],
)
def test_numbers_of_crossings_are_lists_and_ranges(text: str, expected: tuple[int, ...]) -> None:
    assert numbers(text) == expected


@pytest.mark.parametrize("text", ["x", "", "1,1", "3-1", "1,,2", "0-", "99999999", "1-3,2", "²"])
def test_other_numbers_of_crossings_are_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match="--nx takes"):
        numbers(text)


REFUSED = [
    ("x", 'Unknown command "x". Available commands: demo, generate'),
    ("colect", 'Did you mean "collect"?'),
    ("\x1b[2J", r"Unknown command"),
    ("collect --episode 3", "Unknown option: --episode. Did you mean --episodes?"),
    ("evaluate --nx 2 3", "a word too many: 3; several values are one word, such as 2,3"),
    ("collect --set task=convert", "task is a section of settings, such as task.task=; got 'conv"),
    ("collect --set horizon", "--set takes name=value, such as task.horizon=30, got 'horizon'"),
    ("collect --set task.horizon=x", "task.horizon must be a whole number, got 'x'"),
    ("collect --settings {text}", "can't be read as JSON"),
    ("collect --settings {twice.json}", "key 'seed' is there twice"),
    ("evaluate --episodes 100000000000000000000000000", "episodes must be at most 1000000000"),
    (f"generate --nx 1,0-9999{',' * 2000}", "takes whole numbers such as 3, 2,3 or 0-4, got ''\n"),
    ("evaluate --nx 1,0-9999", "--nx takes each number once, got 1 twice\n"),
    ("generate --nx 0-9999", "nx must be from 0 to 11, got 9999\n"),
    ("collect --resume --restart", "give only one of them"),
    ("collect --set run.scheduler=tcp://a:1 --workers 2", "--workers 2 is for local processes"),
    ("collect --set task.hold=99", "hold 99 is longer than the horizon of 50 steps"),
    ("collect --policy nowhere:act", "nowhere"),
    ("collect --id ../x-v0", "x-v0"),
    ("generate --source import", "source must be one of auto, drawing, play, random-walk, got"),
    ("generate --codes {fifo}", "not a regular file"),
    ("evaluate --video film.avi", "a video must end in .gif, .mp4 or .webm"),
    ("images --set test_nx=0", "test-nx takes the largest"),
    ("images --set code_share=0.9", "share"),
    ("suite --states bench --nx 5 --task convert", "no set-up of convert with nx 5"),
    ("suite --states bench --episodes 9", "have a --size, not a number of --episodes"),
    ("suite --size 1M", "--size 1M is of --states bench, not readable"),
    ("prompt", "name the model to ask: --model NAME"),
    ("prompt --model m --mode read", "takes a folder of pictures"),
    ("evaluate --resume", "--resume and --restart need the --out of the evaluation"),
    ("evaluate --set run.shard=1/2 --out {new}/a.json --record {new}/e.h5", "no entry"),
    ("evaluate --policy play --out {new}/a.json", "must be endless"),
    ("train --set clone.nx=2 --out {new}", "settings of the clone are for --learner clone"),
    ("generate --set beads=200", "demonstrations are for a rope of 100 beads, got 200; leave them"),
    ("generate --codes hard-unknots --nx 4", "hard-unknots.txt contains no code with nx 4"),
    ("generate --codes {trefoil}", "shows the knot 3_1, not 0_1; add --knot 3_1"),
    ("dataset merge --out {new}", "name what to merge"),
    ("dataset merge {states} {states}", "give an output"),
    ("dataset import --out {new}", "name the files of curves"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_a_mistake_is_one_line_and_writes_nothing(
    line: str, message: str, here: dict[str, str], capfd: Capture
) -> None:
    def filled(word: str) -> str:
        for name, there in here.items():
            word = word.replace(f"{{{name}}}", there)
        return word

    before = sorted(Path.cwd().rglob("*"))
    status = knotgym(*map(filled, line.split(" ")), "--quiet")
    said = capfd.readouterr().err
    assert status == 2 and len(said.splitlines()) == 1 and said.rstrip("\n").isprintable(), said
    assert said.startswith("knotgym: ") and filled(message) in said
    assert sorted(Path.cwd().rglob("*")) == before


@pytest.mark.parametrize("words", ["", "--help", "collect --help", "dataset -h", "--version"])
def test_help_and_version_are_shown_with_status_0(words: str, capfd: Capture) -> None:
    assert knotgym(*words.split()) == 0
    assert capfd.readouterr().out.startswith(("Usage: knotgym", "knotgym "))


def test_no_help_imports_the_simulator() -> None:
    code = """
import sys
from knotgym.cli.program import application, commands
for words in ([], *([name] for name in commands()), ["dataset", "page"]):
    application()([*words, "--help"], result_action="return_value")
print(*sys.modules, file=sys.stderr)
"""
    modules = set(python("-c", code, check=True).stderr.split())
    heavy = {"cv2", "dask", "h5py", "minari", "mujoco", "numba", "pyarrow", "torch"}
    assert "knotgym.prompting.prompt_command" in modules and modules & heavy == set()


def test_commands_come_from_packages_and_the_core_runs_without_its_guests(tmp_path: Path) -> None:
    copied = copytree(Path(knotgym_package.__file__).parent, tmp_path / "knotgym")
    for guest in ("learn", "prompting", "play"):
        rmtree(copied / guest)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "__init__.py").touch()
    (mine / "commands.toml").write_text('[commands.hello]\nsummary = "Greet."\n')
    (mine / "hello_command.py").write_text(
        'from knotgym.cli import Given, command\n\n\n@command({}, "")\n'
        "def hello(given: Given, *, name: str) -> None:\n"
        '    """Greet.\n\n    Args:\n        name: Who.\n    """\n    print("hello", name)\n'
    )
    described = tmp_path / "mine-1.dist-info"
    described.mkdir()
    (described / "METADATA").write_text("Name: mine\nVersion: 1\n")
    (described / "entry_points.txt").write_text("[knotgym.commands]\nmine = mine\n")
    job = "from knotgym.cli import main\nmain({!r}.split())"
    for words, shown in (
        ("hello --name you", "hello you"),
        ("evaluate --task tie --nx 2 --policy random --episodes 2 --workers 1", "random"),
    ):
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{job.format(words)}"
        assert shown in python("-c", code, check=True).stdout


@pytest.mark.thorough
def test_a_plugin_registers_a_task_in_every_process(tmp_path: Path) -> None:
    task = "import knotgym\nknotgym.register_task('loosen', lambda nx: (nx, nx - 1))\n"
    (tmp_path / "loosen.py").write_text(task)
    job = "import sys; from knotgym.cli import main; sys.path[:0] = {}; main({!r}.split())"
    made = "collect --task loosen --nx 2 --policy random --engine chain --episodes 2 --workers 2"
    for words, installed, said in (
        (f"{made} --out root --plugin loosen", False, "2 episodes"),
        ("dataset verify root", False, "adds others) or a list, got 'loo"),
        ("dataset verify root --plugin loosen", False, "no faults"),
        ("dataset verify root --plugin loosen.py", False, "plugin loosen.py can't be imported"),
        ("dataset verify root", True, "no faults"),
    ):
        if installed:
            (tmp_path / "mine-1.dist-info").mkdir()
            (tmp_path / "mine-1.dist-info/METADATA").write_text("Name: mine\nVersion: 1\n")
            points = tmp_path / "mine-1.dist-info/entry_points.txt"
            points.write_text("[knotgym.plugins]\nmine = loosen\n")
        run = python("-c", job.format([str(tmp_path)] * installed, words), cwd=tmp_path)
        assert said in run.stdout + run.stderr


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        ("evaluate", {"run": {"scheduler": "tcp://127.0.0.1:8786"}}),
        ("evaluate", {"policies": [{"policy": "random"}, {"policy": "mine:act"}]}),
        ("evaluate", {"policy": {"policy": "mine:act"}}),
        ("collect", {"policy": {"policy": "mine:act"}}),
        ("prompt", {"chat": {"base_url": "http://127.0.0.1:1/v1"}}),
        pytest.param("play", {"policy": {"policy": "mine:act"}}, marks=pytest.mark.clients),
    ],
)
def test_a_settings_file_neither_reaches_the_network_nor_names_code(
    command: str, settings: dict[str, Any], tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("open('imported', 'w')\n")
    (tmp_path / "s.json").write_text(json.dumps(settings))
    assert knotgym(command, "--settings", "s.json") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "may not set" in line and "which reaches the network or names code" in line
    assert not (tmp_path / "imported").exists()
