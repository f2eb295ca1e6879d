"""A learner is measured as `knotgym evaluate` measures, and the file says how it was trained."""

from __future__ import annotations

from pathlib import Path

import pytest

from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidPolicy
from knotgym.control import policies
from knotgym.control.old_basic_policies import RandomPolicy
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.learner_evaluation import EVALUATION, evaluate_learner
from knotgym.generate.episodes.suite_scores import read_scores


def test_scores_stand_beside_the_training_and_a_name_is_had_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policies, "_constructors", dict(policies._constructors))
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"of the learner")
    task = TaskConfig(task="tie", observation="state", horizon=2)

    def measured() -> None:
        evaluate_learner(
            "a-learner",
            RandomPolicy(),
            tmp_path,
            {"steps": 7},
            files=[weights],
            quiet=True,
            tasks=("unknot",),
            nx=(2,),
            episodes=2,
            task=task,
        )

    measured()
    (row,) = read_scores([tmp_path / EVALUATION])
    assert (row["policy"], row["task"], row["split"]) == ("a-learner", "unknot", "test")
    assert row["policy_sha256"] == sha256(weights)
    assert row["episodes"] == 2 and row["training"] == {"steps": 7}
    with pytest.raises(InvalidPolicy, match="'a-learner' is already registered"):
        measured()
