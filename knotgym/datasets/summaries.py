"""What a dataset is, in numbers: of episodes, of states and of pictures; and numbers in words."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym import common
from knotgym.common import one_line
from knotgym.datasets.card_texts import CardTable
from knotgym.datasets.episode_dataset import open_episodes
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import read_table, shards
from knotgym.datasets.located import Located
from knotgym.datasets.manifest import read_manifest
from knotgym.datasets.picture_card import picture_tables
from knotgym.datasets.state_card import state_tables
from knotgym.states import read_states

# of the metadata: a word that nothing confirms, and that may be a stranger's
_CLAIMED = ("author", "algorithm_name", "ref_min_score", "ref_max_score", "code_permalink")
_LISTED = 24  # entries of a mapping in words, at most


def show_episodes(source: Any) -> dict[str, Any]:
    """Summarize a file of episodes or a Minari dataset; every value can be written as JSON."""
    dataset = open_episodes(source)
    rows, size = dataset.episodes.episodes, dataset.path.stat().st_size
    goals = gauss_codes(rows["goal_visits"])
    policies = rows["policy"] if len(set(rows["policy"].tolist())) > 1 else np.full(rows.rows, "")
    by_policy = [f"{name} {goal}".strip() for name, goal in zip(policies, goals, strict=True)]
    missed = [] if dataset.task.endless else dataset.episodes.missed(by_policy, rows["success"])
    return {
        "path": str(dataset.path),
        "dataset_id": (dataset.metadata or {}).get("dataset_id"),
        "form": dataset.attributes["form"],
        "task": common.as_json(dataset.task),
        "episodes": rows.rows,
        "steps": int(rows["length"].sum()),
        "lengths": _spread(rows["length"]),
        "returns": _spread(rows["return_"]),
        "successes": int(rows["success"].sum()),
        "success_rate": float(rows["success"].mean()) if rows.rows else None,
        "simulation_failures": int(rows["diverged"].sum()),
        "policies": _counted(rows["policy"]),
        "distinct": dataset.episodes.distinct(),
        "goals": _counted(goals),
        "missed goals": {goal: f"{n} of {of}" for goal, (n, of) in missed} or None,
        "bytes": size,
        "bytes_per_step": size / max(1, int(rows["length"].sum())),
        "rope": dataset.attributes.get("rope"),
        "versions": dataset.attributes.get("versions"),
        "claimed": {k: v for k in _CLAIMED if (v := (dataset.metadata or {}).get(k))} or None,
        "columns nothing can make again": ", ".join(dataset.episodes.claims()) or None,
    }


def _counted(names: NDArray[Any]) -> dict[str, int]:
    return dict(sorted(Counter(names.tolist()).items()))


def _spread(values: NDArray[Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    least, middle, most = np.quantile(values, [0.0, 0.5, 1.0]).tolist()
    return {"min": least, "mean": float(values.mean()), "median": middle, "max": most}


def in_words(value: Any) -> str:
    """Format a value of a summary for reading; "" for None, "none" for one in a mapping."""
    if isinstance(value, Mapping):
        listed = [*value.items()][:_LISTED]
        entries = [f"{name} {in_words(entry) or 'none'}" for name, entry in listed]
        more = len(value) - len(entries)
        return ", ".join(entries) + (f" and {more} more" if more else "")
    if isinstance(value, list):
        is_interval = bool(value) and isinstance(value[0], float)
        return (" to " if is_interval else " and ").join(map(in_words, value))
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else one_line(value)  # a stranger's text


def summary(located: Located) -> tuple[list[dict[str, Any]], list[str], dict[str, CardTable]]:
    """Return the facts about each dataset of episodes; or what states or pictures are, in lines,
    and the tables of facts about them by name.
    """
    if located.kind == "episodes":
        return [show_episodes(path) for path in located.episodes], [], {}
    if located.pictures:
        size = sum(shard.stat().st_size for shard in shards(located.pictures))
        count = len(read_table(located.pictures, columns=["nx"]))
        lines = [f"{count} pictures, {size / count:.0f} bytes each"]
        return [], lines, picture_tables(located.pictures)
    states = read_states(located.states, images=False)
    made = sorted(Counter(states.source.get("policy", np.empty(0, str)).tolist()).items())
    lines = [f"{len(states)} states"]
    lines += [f"sources: {', '.join(f'{policy} {count}' for policy, count in made)}"] * bool(made)
    report = read_manifest(located.folder)[0].get("report", {})
    return [], lines, state_tables(states, report)
