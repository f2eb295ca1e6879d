"""Files that commit 845eceab wrote stay valid: read, verified, merged, and made columns again.

evaluate / collect --task tie --nx 2 --engine chain --set task.horizon=16 --set labels=expert
"""

from pathlib import Path

import knotgym
from knotgym.control import replay
from knotgym.datasets import export, merge, open_episodes
from knotgym.loaders import arrays

from ..small_job import knotgym as typed

OLD = Path(__file__).parents[1] / "data/845eceab"


def test_old_files_are_read_verified_and_merged(tmp_path: Path) -> None:
    labelled, recording = (open_episodes(OLD / f"{name}.h5") for name in ("labelled", "recording"))
    assert labelled.episodes.differences(recording.episodes) == []
    assert [*labelled.episodes.claims()] == ["steps/expert_action"]
    for one in (labelled, recording):
        assert knotgym.verify(one.path) == []
    export(str(recording.path), tmp_path / "again.h5", "columns", replay)
    assert open_episodes(tmp_path / "again.h5").episodes.differences(labelled.episodes) == []
    other = tmp_path / "other.h5"
    task = ("--task", "tie", "--nx", 2, "--engine", "chain", "--set", "task.horizon=16")
    typed("collect", *task, "--policy", "random", "--episodes", 1, "--seed", 1, "--workers", 1,
          "--id", "a/b-v0", "--out", tmp_path, "--quiet")  # fmt: skip
    merge([str(labelled.path), str(tmp_path / "a/b-v0")], other)
    assert knotgym.verify(other) == [] and "engine" not in open_episodes(other).attributes
    assert arrays(other, observation="state")["actions"].shape[1] == 6
