"""A column added to a schema reaches every place that steps pass, or is refused by name."""

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
"""


@pytest.mark.parametrize(("of", "says"), [("state", "nothing computes"), ("pull", "nothing fills")])
def test_a_new_column_that_nothing_fills_is_refused(of: str, says: str, tmp_path: Path) -> None:
    words = "collect --task tie --nx 1 --policy random --episodes 1 --workers 1 --out ."
    added = ADDED.replace("{how}", f"of={of!r}, stepped=True")
    ended = python("-c", f"{added}from knotgym import cli\ncli.main({words.split()})", cwd=tmp_path)
    assert ended.returncode and f"{says} column height of steps" in ended.stderr
    assert not [*tmp_path.rglob("*.h5")]


# what a stranger adds to episodes.toml
LIKELY = """
import tomllib
from unittest import mock
_loads = tomllib.loads
def loads(text):
    found = _loads(text)
    if "planned" in found:
        found["pulls"]["log_prob"] = dict(of="pull", dtype="float32", optional=True)
        found["played"]["margin"] = dict(dtype="float64", optional=True)
    return found
with mock.patch("tomllib.loads", loads):
    import knotgym.datasets.episodes as schemas
def margin(made):
    return made.steps["observation"][made.last(), :, 2].max(axis=1).astype(float)
schemas.EPISODES = schemas.EPISODES._replace(columns=tuple(
    c._replace(derived=margin) if c.name == "margin" else c for c in schemas.EPISODES.columns))
"""
ROUND = """
from functools import partial
from pathlib import Path
import h5py, numpy as np
import knotgym
from knotgym.control import make_policy, PolicyConfig, replay, rollouts, Pulls
from knotgym.control.sampler import SimplePolicy
from knotgym.datasets import (
    MinariMetadata, export, merge, open_episodes, select, split, write_episodes
)
from knotgym.envs import TaskConfig

class Likely:
    def __init__(self, inner): self.inner, self.planned = inner, inner.planned
    def begin(self, ids, rngs): self.inner.begin(ids, rngs)
    def act(self, ids):
        pulls = self.inner.act(ids)
        return pulls._replace(given={"log_prob": -pulls.beads.astype("float32")})

TASK = TaskConfig(task="tie", nx=1, engine="chain", observation="state", horizon=4)
plain, expert = (make_policy(PolicyConfig(policy=p)) for p in ("random", "expert"))
likely = SimplePolicy("random", lambda batch: Likely(plain.player(batch)))
own = lambda batch, ids: {"turn": batch.steps[ids] * np.float32(2)}
made = rollouts(likely, TASK, range(4), adviser=plain, columns=own)
other = rollouts(expert, TASK, range(4, 6))  # neither labels nor log_prob, but macro-actions
GIVEN = ["log_prob", "expert_action", "info/turn"]
older = other.episodes.only(*{*other.episodes} - {"margin"})  # as of before the column
other = other._replace(episodes=older)
write_episodes("made.h5", [made], TASK); write_episodes("other.h5", [other], TASK)

def right(source, rows=None):
    found = open_episodes(source).episodes
    if not found.is_recording:
        steps = found.steps
        assert np.array_equal(steps["height"], steps["observation"][..., 2].max(axis=1)), source
    want = made if rows is None else made.select(rows)
    for name in GIVEN:
        own = found.steps[name][: want.steps.rows]
        assert np.array_equal(own, want.steps[name]), (source, name)
    assert knotgym.verify(source) == [], knotgym.verify(source)
    return found

assert (made.steps["info/turn"][made.last()] > 0).all() and made.steps["log_prob"].any()
assert (made.episodes["margin"] > 0).all()
right("made.h5")
both = "both.h5"
merge(["made.h5", "other.h5"], Path(both))
left = right(both).steps
for name in GIVEN:
    assert np.isnan(left[name][made.steps.rows:]).all(), name
assert not left["macro_side"][: made.steps.rows].any() and left["macro_side"].any()
right(select("made.h5", "some.h5", where="episode > 1"), [2, 3])
for path in split("made.h5", "a=0.5,b=0.5", "parts.h5"):
    assert {*GIVEN, "height"} <= {*open_episodes(path).episodes.steps}
export(both, Path("pulls.h5"), "recording", replay)
assert right("pulls.h5").is_recording
export("pulls.h5", Path("again.h5"), "columns", replay)
right("again.h5")
merge([both], Path("."), "a/b-v0")
right("a/b-v0")
with h5py.File("a/b-v0/data/main_data.hdf5") as file:
    one = file["episode_0/infos"]
    assert np.array_equal(one["expert_action"], made.select([0]).steps["expert_action"])
    assert (one["height"][()] > 0).all()  # in the last row too
    assert one["info_turn"][1] == 2 and one["log_prob"][1] == made.steps["log_prob"][0]
for name, says in {**dict.fromkeys(GIVEN, "digest"), "height": "height differs"}.items():
    with h5py.File(both, "a") as file:
        column = file[f"steps/{name}"]
        was, column[1] = column[1], column[1] + 1
    assert any(name in fault and says in fault for fault in knotgym.verify(both)), name
    with h5py.File(both, "a") as file:
        file[f"steps/{name}"][1] = was
try:
    import pyarrow.parquet as parquet
except ImportError:
    raise SystemExit
export("made.h5", Path("hub"), "huggingface", replay)
found = parquet.read_table("hub/data/steps/train-00000-of-00001.parquet")
assert {"log_prob", "info_turn", "height"} <= {*found.column_names}
assert np.array_equal(found["info_turn"].to_numpy(), made.steps["info/turn"])
"""


def test_what_is_given_goes_everywhere(tmp_path: Path) -> None:
    """A column of states, labels, a behaviour's log-probability, a user's info, one of episodes."""
    added = ADDED.replace("{how}", "of='state', derived=height")
    ended = python("-c", LIKELY + added + ROUND, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
