"""Read the scores in files of `knotgym evaluate --out`."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from knotgym.common import InvalidFile, as_json
from knotgym.control import PolicyConfig
from knotgym.generate import EvaluateConfig, evaluation_in
from knotgym.runs import cluster_interval

# Episodes that agree in all of these fields are pooled: LINE says what played, CELL where.
LINE = ("policy", "settings", "policy_sha256", "code_sha256", "versions")
CELL = ("states", "states_sha256", "split", "task", "nx")
_APART = ("task", "nx", "split", "states")  # fields of a task that have their own column
_PLAIN = {
    "task": as_json(EvaluateConfig(policies=(PolicyConfig(),)).task),
    "policy": as_json(PolicyConfig()),
}


def read_scores(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Return one row per cell of all evaluations, sorted.

    A row has the fields of `LINE` and `CELL`, episodes, successes, success_rate, interval, steps,
    starts and goals (their numbers), seeds, and `training`, how a learner was trained. Files of one
    cell with different seeds are pooled; different policies, settings, states or code have separate
    rows.

    Raises:
        InvalidFile: a file can't be read, or two have the same episodes.
    """
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for path in paths:
        with evaluation_in(path) as (content, results):
            rows = list(_rows(content, results))
        for row in rows:
            same = found.setdefault(tuple(row[name] for name in (*LINE, *CELL)), [])
            if any(row["seeds"] == one["seeds"] for one in same):
                cell = (row["policy"], *(row[name] for name in CELL if name != "states_sha256"))
                raise InvalidFile(f"{path} repeats episodes of {', '.join(map(str, cell))}")
            same.append(row)
    return [_together(found[key]) for key in sorted(found, key=str)]


def _rows(evaluation: Mapping[str, Any], results: Iterable[Any]) -> Iterator[dict[str, Any]]:
    config, source = evaluation["config"], evaluation["source"]
    configs = {one["policy"]: one for one in config["policies"]}
    versions = dict(evaluation["versions"])
    code = versions.pop("code")
    for one in results:
        task = {name: value for name, value in config["task"].items() if name not in _APART}
        task["action"] = one.action  # a policy may choose its own
        plain = {**_PLAIN["policy"], "policy": one.policy}
        settings = [*_unlike(_PLAIN["task"], task), *_unlike(plain, configs[one.policy])]
        origins = sorted({one.start_states, one.goal_states})
        training = dict(evaluation["learners"].get(one.policy, {}))
        row = {
            "policy": one.policy,
            "settings": "; ".join(settings),
            "policy_sha256": _digest(source["policies"][one.policy]),
            "code_sha256": code,
            "versions": ", ".join(f"{name} {versions[name]}" for name in sorted(versions)),
            "states": config["task"]["states"] or "readable",
            "states_sha256": _digest({origin: source["states"][origin] for origin in origins}),
            "split": one.split,
            "task": one.task,
            "nx": one.nx,
            "seeds": [config["seed"]],
            "training": training,
            "outcomes": one.outcomes,
        }
        for name in (*LINE, *CELL):
            if name != "nx" and not (isinstance(row[name], str) and row[name].isprintable()):
                raise InvalidFile(f"{name} is {row[name]!r}")
        float(training.get("seconds") or 0)
        yield row


def _together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Pool rows of one cell."""
    rows = sorted(rows, key=lambda row: str(row["seeds"]))
    columns = {
        name: [value for row in rows for value in row["outcomes"][name]]
        for name in rows[0]["outcomes"]
    }
    success, episodes = columns["success"], len(columns["success"])
    reached = [steps for steps, done in zip(columns["steps"], success, strict=True) if done]
    return {
        **{name: value for name, value in rows[0].items() if name != "outcomes"},
        "episodes": episodes,
        "successes": sum(success),
        "success_rate": sum(success) / episodes,
        "interval": list(cluster_interval(success, columns["start"], columns["goal"])),
        "steps": sum(reached) / len(reached) if reached else None,
        "starts": len(set(columns["start"])),
        "goals": len(set(columns["goal"])),
        "seeds": sorted(seed for row in rows for seed in row["seeds"]),
    }


def _unlike(plain: Any, value: Any, where: str = "") -> Iterator[str]:
    """Yield the settings that differ from the defaults, as in "planner.budget=1000"."""
    if isinstance(value, dict):
        for name, inner in value.items():
            beside = plain.get(name) if isinstance(plain, dict) else None
            yield from _unlike(beside, inner, f"{where}.{name}" if where else str(name))
    elif plain != value:
        yield f"{where}={json.dumps(value)}"


def _digest(files: Mapping[str, str]) -> str:
    """Combine digests into one; a single file keeps its own, and "" stands for none."""
    if len(files) < 2:
        return "".join(files.values())
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()
