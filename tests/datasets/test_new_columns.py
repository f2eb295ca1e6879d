"""A column added to a schema reaches every place that steps pass, or is refused by name."""

import subprocess
from pathlib import Path

import pytest

from ..fresh_interpreter import python

ADDED = """
import sys
from pathlib import Path
import knotgym.datasets.episodes as schemas
from knotgym.common import Column

def height(shown):
    return shown.observation[..., 2].max(axis=1)

new = Column("height", "float32", (), "m", "of the highest bead", optional=True, {how})
schemas.STEPS = schemas.STEPS._replace(columns=(*schemas.STEPS.columns, new))
schemas.FORMS["columns"] = schemas.EPISODES, schemas.STEPS
"""
PLAYED = """
import knotgym
from knotgym.cli import main
from knotgym.datasets import columns_of
from knotgym.loaders import arrays

def run(*words):
    try:
        main([*map(str, words), "--quiet"])
    except SystemExit as ended:
        assert not ended.code, words

collect = "collect --task tie --nx 1 --policy random --episodes 3 --workers 1".split()
collect += ["--set", "task.horizon=3"]
for seed in (0, 1):
    run(*collect, "--seed", seed, "--id", f"a/s{seed}-v0", "--out", ".")
one, other, out = "a/s0-v0", "a/s1-v0", Path("out.h5")

def right(source):
    steps = columns_of(source).episodes.steps
    assert (steps["height"] == steps["observation"][..., 2].max(axis=1)).all(), source
    assert (steps["height"] > 0).all()  # in the last row too

right(one)
assert knotgym.verify(one) == []
run("dataset", "merge", one, other, "--out", "both.h5")
run("dataset", "select", "both.h5", "--sample", 4, "--out", "some.h5")
run("dataset", "export", "some.h5", "--to", "recording", "--out", "pulls.h5")
run("dataset", "export", "pulls.h5", "--to", "columns", "--out", "again.h5")
for name in ("both.h5", "some.h5", "again.h5"):
    right(name)
    assert knotgym.verify(name) == []
run("dataset", "merge", "both.h5", "--id", "a/b-v0", "--out", ".")
import h5py
with h5py.File("a/b-v0/data/main_data.hdf5") as file:
    assert (file["episode_0/infos/height"][()] > 0).all()
with h5py.File("some.h5", "a") as file:
    file["steps/height"][1] += 1
assert any("height differs" in fault for fault in knotgym.verify("some.h5"))
try:
    import pyarrow.parquet as parquet
except ImportError:
    sys.exit()
run("dataset", "export", "both.h5", "--to", "huggingface", "--out", "hub")
found = parquet.read_table("hub/data/steps/train-00000-of-00001.parquet")["height"].to_numpy()
assert (found == columns_of("both.h5").episodes.steps["height"]).all()
"""


def script(how: str, then: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a script in a fresh process, whose schema has one more column."""
    return python("-c", ADDED.replace("{how}", how) + then, cwd=folder)


def test_a_new_column_of_states_goes_everywhere(tmp_path: Path) -> None:
    ended = script("of='state', derived=height", PLAYED, tmp_path)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize(
    ("how", "says"), [("of='state'", "nothing computes"), ("of='pull'", "nothing fills")]
)
def test_a_new_column_that_nothing_fills_is_refused(how: str, says: str, tmp_path: Path) -> None:
    words = "collect --task tie --nx 1 --policy random --episodes 1 --workers 1 --out ."
    ended = script(how, f"from knotgym.cli import main\nmain({words.split()})", tmp_path)
    assert ended.returncode and f"{says} column height of steps" in ended.stderr
    assert not [*tmp_path.rglob("*.h5")]
