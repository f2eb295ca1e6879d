"""Hundreds of mistaken command lines, made of the commands' own options: each is one line and exit
status 2, and writes nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from knotgym.cli import main as cli
from knotgym.rope.simulation import Simulation
from knotgym.states.state_file import shipped

from ..small_job import knotgym

# what else a command needs, so that one option alone is wrong
BASES: dict[str, tuple[str, ...]] = {
    "generate": ("--nx", "0", "--count", "1", "--workers", "1", "--out", "{new}"),
    "images": ("--nx", "0", "--count", "1", "--workers", "1", "--out", "{new}"),
    "collect": ("--episodes", "1", "--policy", "random", "--workers", "1", "--out", "{new}"),
    "evaluate": ("--episodes", "1", "--workers", "1"),
    "suite": ("--episodes", "1", "--workers", "1", "--out", "{new}"),
    "train": ("--data", "{absent}", "--out", "{new}"),
    "prompt": ("--model", "m", "--base-url", "http://127.0.0.1:9", "--attempts", "1")
    + ("--backoff", "0", "--out", "{new}"),
    "dataset show": ("{states}",),
    "dataset gallery": ("{states}", "--out", "{new}.png"),
    "dataset verify": ("{states}",),
    "dataset merge": ("{states}", "--out", "{new}.h5"),
    "dataset replay": ("{states}", "--out", "{new}.gif"),
    "dataset page": ("{states}", "--out", "{new}.html"),
    "dataset export": ("{states}", "--out", "{new}"),
    "dataset import": ("{absent}.csv", "--out", "{new}.h5"),
    "dataset select": ("{states}", "--out", "{new}.h5"),
    "dataset split": ("{states}", "--parts", "a=0.5,b=0.5", "--out", "{new}.h5"),
    "dataset delete": ("{states}", "--rows", "0", "--out", "{new}.h5"),
}
NOT_WHOLE = ("x", "1.5", "", "nan", "1e3", "0x1", "\x1b[2J", "-1")
NOT_REAL = ("x", "", "1,5", "nan", "\x1b[2J")
NO_FOLDER = ("/dev/null/x", "{long}", "{fifo}/x")
NO_INPUT = ("/dev/null/x", "{long}", "{fifo}", "{absent}", "{empty}", "\x1b[2J", "{text}")
# of options that take words; and of numbers what their type allows and their meaning doesn't
WORDS: dict[str, tuple[str, ...]] = {
    "--nx": ("x", "", "1,1", "3-1", "1,,2", "0-", "99999999", "\x1b[2J", "1-3,2", "²"),
    "--test-nx": ("x", "", "1,1", "\x1b[2J", "2-1"),
    "--source": ("x", "", "Play", "\x1b[2J"),
    "--split-by": ("x", "", "\x1b[2J"),
    "--knot": ("x", "", "{fifo}", "{empty}", "{text}", "99_99", "\x1b[2J"),
    "--shard": ("x", "0/2", "3/2", "1/0", "1/2/3", "-1/2", "1.5/2", "\x1b[2J"),
    "--executor": ("x", "", "\x1b[2J"),
    "--scheduler": ("x", "tcp://127.0.0.1:1"),
    "--task": ("x", "", "tie,x", "\x1b[2J"),
    "--split": ("x", "both", "\x1b[2J"),
    "--observation": ("x", "", "\x1b[2J"),
    "--views": ("x", "", "top,top", "top,x", "\x1b[2J"),
    "--policy": ("x", "", "prompt:{absent}", "{absent}.zip", "{empty}", "{text}.pt", "a:b", "\x1b"),
    "--policies": ("x", "", "random,x", "\x1b[2J"),
    "--shares": ("x", "", "1", "inf,1,1,1", "nan,1,1,1", "-1,1,1,1", "0,0,0,0", "1,1,1,1,1"),
    "--vary": ("x", "", "colours,x", "\x1b[2J"),
    "--size": ("x", "", "0", "1", "1e9", "99999999", "-64", "²", "\x1b[2J"),
    "--where": ("x", "nx", "nx == 'a'", "__import__('os')", "nx ==", "\x1b[2J"),
    "--parts": ("x", "", "a=1", "a=0.5,b=0.6", "a=0.5,a=0.5", "\x1b[2J"),
    "--rows": ("x", "", "-1", "99999", "3-1", "0-99999999999", "\x1b[2J"),
    "--sample": ("0", "99999"),
    "--mode": ("x", "", "\x1b[2J"),
    "--engine": ("x", "", "\x1b[2J"),
    "--camera": ("x", "", "\x1b[2J"),
    "--to": ("x", "", "\x1b[2J"),
    "--id": ("..", "../x-v0", "/x-v0", "x", "a b", "\x1b[2J", "{long}-v0"),
    "--base-url": ("x", "", "file:///dev/zero", "\x1b[2J"),
    "--settings": NO_INPUT,
    "--archive": NO_INPUT,
    "--codes": NO_INPUT,
    "--states": NO_INPUT,
    "--scores": NO_INPUT,
    "--data": NO_INPUT,
    "--out": NO_FOLDER,
    "--video": (*NO_FOLDER, "{new}.txt"),
    "--noise": ("2", "-0.1", "inf"),
    "--reset-noise": ("-0.1", "inf"),
    "--tow-limit": ("-1", "0"),
    "--test-share": ("2", "-0.1", "inf"),
    "--code-share": ("2", "-0.1", "inf"),
    "--timeout": ("0", "-1", "inf"),
    "--backoff": ("-1", "inf"),
    "--temperature": ("inf",),
    "--prompt-price": ("-1", "inf"),
    "--completion-price": ("-1", "inf"),
    "--image-size": ("0", "1", "99999999"),
    "--count": ("0",),
    "--episodes": ("0", "x", "random=x", "x=1", "-1"),
    "--horizon": ("0",),
    "--hold": ("0", "999"),
    "--integrator-steps": ("0",),
    "--budget": ("-1",),
    "--steps": ("0",),
    "--columns": ("0",),
    "--window": (),
    "--row": ("99999",),
    "--side-by-side": ("0",),
}
FREE = {"--author", "--author-email", "--code-permalink", "--model"}  # any words will do
GOES_WITH: dict[str, tuple[str, ...]] = {}


def lines() -> Iterator[tuple[str, ...]]:
    """Every mistaken line; what stands in braces is filled in by the test."""
    yield from [("x",), ("--x",), ("dataset", "x"), ("dataset", "--x"), ("\x1b[2J",)]
    app: Any = typer.main.get_command(cli.app)
    for name, base in BASES.items():
        command = app
        for word in name.split():
            command = command.commands[word]
        words = tuple(name.split())
        yield (*words, *base, "--x")
        yield (*words, *base, "surplus", *["surplus"] * (name == "prompt"))
        if name.startswith("dataset"):
            yield words
            yield from ((*words, bad, *base[1:]) for bad in (*NO_INPUT, "../x", ".."))
        for parameter in command.params:
            option = max((one for one in parameter.opts if one.startswith("--")), default="")
            if not option or parameter.is_flag:
                continue
            yield (*words, *base, option)
            kind = parameter.type_descriptor.annotation
            numbers = {int: NOT_WHOLE, float: NOT_REAL}.get(kind, ())
            others = _without(base, option)
            for bad in dict.fromkeys(
                (*numbers, *(() if option in FREE else WORDS.get(option, ())))
            ):
                yield (*words, *others, *GOES_WITH.get(option, ()), option, bad)


def _without(base: tuple[str, ...], option: str) -> tuple[str, ...]:
    """The words that a command needs but for an option and its value."""
    if option not in base:
        return base
    at = base.index(option)
    return base[:at] + base[at + 2 :]


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What lines name: things that are there, and that aren't."""
    here = tmp_path / "here"  # else `..` would be what other tests have left
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(here / "minari"))
    os.mkfifo(here / "fifo")
    (here / "empty").mkdir()
    for name in ("text", "text.pt"):
        (here / name).write_text("neither JSON nor a table\n", encoding="utf-8")

    def act(*_: Any) -> None:
        raise AssertionError("a mistaken command began to work")

    monkeypatch.setattr(Simulation, "act", act)
    there = {name: str(here / name) for name in ("fifo", "empty", "text", "new", "absent")}
    return {**there, "states": str(shipped("hard-unknots")), "long": "a" * 300}


def complaints(
    chosen: list[tuple[str, ...]], room: dict[str, str], capfd: pytest.CaptureFixture[str]
) -> list[str]:
    """What is wrong with how lines end."""
    found = []
    for line in chosen:
        before = sorted(Path.cwd().rglob("*"))
        words = [_filled(word, room) for word in line]
        status = knotgym(*words)
        said = capfd.readouterr().err
        wrong = [] if status == 2 else [f"status {status}"]
        if len(said.splitlines()) != 1 or not said.rstrip("\n").isprintable():
            wrong.append(f"says {said[-300:]!r}")
        if sorted(Path.cwd().rglob("*")) != before:
            wrong.append("wrote something")
        found += [f"{' '.join(map(repr, line))}: {', '.join(wrong)}"] if wrong else []
    return found


def _filled(word: str, room: dict[str, str]) -> str:
    for name, there in room.items():
        word = word.replace(f"{{{name}}}", there)
    return word


def test_there_are_more_than_four_hundred_mistakes() -> None:
    assert len(set(lines())) >= 400


def test_some_mistakes_of_every_command_are_one_line(
    room: dict[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    assert complaints(list(lines())[::16], room, capfd) == []


@pytest.mark.parametrize("command", ["collect", "evaluate", "prompt"])
def test_a_hold_past_the_horizon_is_one_line(
    command: str, room: dict[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    line = (command, *BASES[command], "--hold", "999")
    assert complaints([line], room, capfd) == []
    assert knotgym(*(_filled(word, room) for word in line)) == 2
    assert "hold 999 is longer than the horizon of" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_every_mistake_is_one_line(
    part: int, room: dict[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    assert "\n".join(complaints(list(lines())[part::4], room, capfd)) == ""
