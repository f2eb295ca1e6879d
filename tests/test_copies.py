"""A stranger changes a copy of the package in one place: it is right everywhere, or refused."""

import os
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

import knotgym

from .fresh_interpreter import python

HERE = Path(knotgym.__file__).parent
# file, text, what takes its place, script that runs in the copy, and the end of what it says
TIERS = """
from knotgym.generate import SuiteConfig
sets = lambda **words: [*SuiteConfig(states=("bench",), **words).sets()]
assert {one.steps for one in sets()} == {10_000}, "the default is named, not the first"
assert len(sets()) == 70
(one,) = sets(size="1k", policies=("scripted",), tasks=("unknot",), nx=(2,))
assert (one.dataset_id, one.steps, one.form) == (
    "knotgym/unknot-nx2/scripted-chain-bench-1k-v0", 1_000, "columns"
)
from knotgym.cli import main
main(["suite", "--help"])
"""
CHANGES = {
    "tier and size": (
        "generate/data/suite.toml",
        {
            "[bench.sizes]\n": '[bench.sizes]\n1k = { steps = 1_000, form = "columns" }\n',
            'policies = ["random", "wander",': 'policies = ["random", "scripted", "wander",',
        },
        TIERS,
        "size",
    )
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_of_a_copy(name: str, tmp_path: Path) -> None:
    file, changes, script, said = CHANGES[name]
    copytree(HERE, tmp_path / "knotgym", ignore=ignore_patterns("__pycache__"))
    text = (tmp_path / "knotgym" / file).read_text()
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    (tmp_path / "knotgym" / file).write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    ran = python("-c", script, cwd=tmp_path, env=environment)
    assert ran.returncode == 0 and said in ran.stdout, ran.stdout + ran.stderr
