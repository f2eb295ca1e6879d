"""How a learner that a script trained is measured: in the episodes of `knotgym evaluate`, into a
file as it writes, which `benchmarks/results.py` reads.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from knotgym.atomic_files import atomic_write
from knotgym.control.policies import Policy, PolicyConfig, register_policy
from knotgym.generate.episodes.evaluate import EvaluateConfig, as_text, run

EVALUATION = "evaluation.json"


def evaluate_learner(
    name: str,
    policy: Policy,
    folder: Path,
    training: dict[str, Any],
    *,
    files: Sequence[Path],
    quiet: bool = False,
    **settings: Any,
) -> dict[str, Any]:
    """Play every set-up in this process, and write `evaluation.json` into the folder.

    Args:
        name: what the results call the policy; it stays registered, so no other may have it.
        policy: it acts in all episodes.
        folder: where to write.
        training: JSON, how the learner was trained.
        files: the learner's weights, already written; the result holds their digests.
        quiet: don't show the table.
        settings: of `EvaluateConfig`, all but its policies.

    Returns:
        What the file holds: that of `knotgym evaluate --out`, and `training`.

    Raises:
        InvalidPolicy: there is a policy of this name already.
        InvalidEvaluation, InvalidSetting: settings that can't be had.
    """
    register_policy(name, lambda _: policy, files)
    config = EvaluateConfig(policies=(PolicyConfig(policy=name),), **settings)
    path = folder / EVALUATION
    run(config, workers=1, out=path, video=None, quiet=quiet, console=Console())
    told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    told["training"] = training
    with atomic_write(path) as part:
        part.write_text(as_text(told), encoding="utf-8")
    return told
