"""Evaluate a learner trained by a script, as `knotgym evaluate` does, with the same result file.

`benchmarks/results.py` reads the file.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.control.policies import register_policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import Policy
from knotgym.generate.episodes.evaluate import as_text, run
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.runs.run_options import RunOptions

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
    """Evaluate a policy on every setup in this process; write `evaluation.json` into the folder.

    Args:
        name: name of the policy in the results; it stays registered, so it must be unique.
        policy: the policy to evaluate.
        folder: where to write.
        training: JSON, how the learner was trained.
        files: the learner's weights, already written; the result has their digests.
        settings: fields of `EvaluateConfig` other than its policies.

    Returns:
        The content of the file: that of `knotgym evaluate --out`, and `training`.

    Raises:
        InvalidPolicy: a policy of this name exists already.
        InvalidInput: the settings are invalid.
    """
    register_policy(name, lambda _: policy, files)
    config = EvaluateConfig(policies=(PolicyConfig(policy=name),), **settings)
    path = folder / EVALUATION
    run(config, RunOptions(workers=1, quiet=quiet), out=path)
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    content["training"] = training
    with atomic_write(path) as part:
        part.write_text(as_text(content), encoding="utf-8")
    return content
