"""The page of a dataset: template, style, scripts and data in one HTML file, without the network.

The data are an escaped JSON block that can't contain markup; the script shows them as text only.
Vertices are int16 in base64.

Ropes are centred at the origin, as in the pictures, in units of 0.1 mm. Large datasets are sampled
evenly, and the page says so.
"""

import base64
import html
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Counts, InvalidFile, InvalidInput, as_json
from knotgym.datasets.episode_dataset import EpisodeDataset, columns_of
from knotgym.datasets.episode_verification import Replay, expanded
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import measures_of, points_of, read_table
from knotgym.datasets.located import Located
from knotgym.datasets.manifest import read_manifest
from knotgym.quality import GRADES
from knotgym.rendering import bead_colours
from knotgym.rope import RopeConfig
from knotgym.states import read_states
from knotgym.topology import find_crossings

_UNIT = 1e-4  # metres
MOST_STATES = 1500  # about 1.3 kB each
MOST_PICTURES, _PICTURE_BYTES = 400, 8e6  # whichever is reached first
MOST_FRAMES = 7000  # states of all episodes, about 1.1 kB each
MOST_STEPS = 1000  # steps of one episode
_SHOWN = ("nx", "gauss_code", "gauss_code_chiral", "split", "knot")
_OF_PICTURES = ("points", "quality", "grade", "image", "crossings", "line", "strands")
_LONGEST_TEXT = 20_000  # characters; a longer configuration is cut
_SCRIPTS = ("rope.js", "plots.js", "page.js")


def write_page(path: Path, located: Located, replay: Replay) -> str:
    """Write the page of datasets; return a one-line summary. `replay` plays those of recordings."""
    data = _page_data(located.title, located, replay)
    path.write_text(_page_html(data), encoding="utf-8")
    return " ".join([f"{data['says']}, {path.stat().st_size / 1e6:.1f} MB.", *data["notices"]])


def _page_data(title: str, given: Located, replay: Replay | None = None) -> dict[str, Any]:
    """Collect everything that the page of datasets shows; the result can be written as JSON.

    The manifest of a run beside its states is shown too.

    Raises:
        InvalidInput: there are no rows.
    """
    rope, notices, about = RopeConfig(), list[str](), dict[str, Any]()
    data: dict[str, Any] = {
        **{name: [] for name in ("measures", "words", "states", "episodes")},
        **{"title": title, "unit": _UNIT, "points": "", "rejected": {}, "notices": notices},
        **{"grades": GRADES, "called": "pictures" if given.pictures else "states"},
        **{"radius": rope.radius, "maxForce": rope.max_force, "beads": rope.beads},
    }
    if given.episodes:
        data |= _episodes(given.episodes, notices, about, replay)
    if given.states is not None:
        shapes = _states(given.states, notices, about)
        if given.episodes and shapes["beads"] != data["beads"]:
            raise InvalidInput(f"{title} has states and episodes of unlike ropes; show one of them")
        data |= shapes
    if given.pictures is not None:
        data |= _pictures(given.pictures, notices, about)
    data["colours"] = ["#" + bytes(colour).hex() for colour in bead_colours(data["beads"])]
    data["about"] = [[name, _cut(value)] for name, value in about.items() if value]
    counts = {data["called"].removesuffix("s"): data["states"], "episode": data["episodes"]}
    contents = [
        f"{len(rows)} {kind}{'s' * (len(rows) != 1)}" for kind, rows in counts.items() if rows
    ]
    if not contents:
        raise InvalidInput(f"{title} has no rows, so there is nothing to show")
    return {**data, "says": ", ".join(contents)}


def _page_html(data: Mapping[str, Any]) -> str:
    """Return the page of the result of `_page_data`."""
    script = "\n".join(_part(name) for name in _SCRIPTS)
    start = 'const DATA = JSON.parse(document.getElementById("data").textContent);'
    return Template(_part("page.html")).substitute(
        title=html.escape(str(data["title"])),
        style=_part("page.css"),
        data=_as_text(data),
        script=f'(() => {{\n"use strict";\n{start}\n{script}\n}})();',
    )


def _as_text(data: Mapping[str, Any]) -> str:
    """Serialize to JSON without characters that are special in HTML."""
    with InvalidFile.instead(f"{data['title']} holds numbers that aren't finite", ValueError):
        text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _part(name: str) -> str:
    return (files("knotgym.datasets") / "page_files" / name).read_text(encoding="utf-8")


def _sampled(count: int, most: int, what: str = "", notices: Any = None) -> list[int]:
    """Choose up to `most` of `count` rows, evenly spaced; add what was left out to the notices.

    >>> _sampled(5, 3), _sampled(2, 3)
    ([0, 2, 4], [0, 1])
    """
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    if what and len(rows) < count:
        notices.append(f"Showing {len(rows)} of {count} {what}, evenly sampled.")
    return rows


def _states(file: Path, notices: list[str], about: dict[str, Any]) -> dict[str, Any]:
    """Collect a state file and the report of the run in the manifest beside it."""
    states = read_states(file, images=False)
    report = read_manifest(file.parent)[0].get("report", {})
    rows = _sampled(len(states), MOST_STATES, "states", notices)
    chosen = states.take(rows)
    known = {name for name, (_, values) in states.measures.items() if np.isfinite(values).any()}
    measures = {name: values for name, values in chosen.measures.items() if name in known}
    shapes = _shapes(rows, chosen.table, measures)
    made = {"steps": "steps", "set": "dataset", "trajectory": "trajectory"}
    for name, column in made.items() if "dataset" in chosen.source else ():
        for shown, value in zip(shapes["states"], chosen.source[column].tolist(), strict=True):
            shown[name] = value
    about |= {
        "states": len(states),
        "drawings made": report.get("attempts"),
        **_versions(states.attributes),
        "configuration": states.attributes.get("config"),
    }
    rejected = {nx: counts for nx, counts in report.get("rejected", {}).items() if counts}
    return {**shapes, "beads": states.points.shape[1], "rejected": rejected}


def _pictures(source: Path, notices: list[str], about: dict[str, Any]) -> dict[str, Any]:
    """Collect a perception table: states with their pictures."""
    table = read_table(source, columns=[*_SHOWN, *_OF_PICTURES])
    each = 4 / 3 * table.nbytes / max(1, len(table))  # base64
    most = min(MOST_PICTURES, int(_PICTURE_BYTES / max(1, each)))
    rows = _sampled(len(table), most, "pictures", notices)
    taken = table.take(rows)
    columns = {name: taken[name].to_pylist() for name in _SHOWN}
    shapes = _shapes(rows, {**columns, "points": points_of(taken)}, measures_of(taken))
    for shown, row in zip(shapes["states"], taken.to_pylist(), strict=True):
        shown |= {"grade": row["grade"], "image": _picture(row["image"])}
        shown["at"] = [[_number(place["x"]), _number(place["y"])] for place in row["crossings"]]
        if "line" in row:  # x, y and depth of each bead
            line = np.reshape(row["line"], (-1, 3))[:, :2].ravel()
            shown |= {"line": [_number(n) for n in line], "masks": _picture(row["strands"])}
    about |= {"pictures": len(table), "configuration": read_manifest(source)[0].get("config")}
    return {**shapes, "words": ["grade"]}


def _shapes(
    rows: Sequence[int], columns: Mapping[str, Any], measures: Mapping[str, tuple[str, Any]]
) -> dict[str, Any]:
    """Return what states and pictures have in common, of the rows with these numbers."""
    points = columns["points"]
    return {
        "measures": [{"name": name, "unit": unit} for name, (unit, _) in measures.items()],
        "points": _encoded(points),
        "states": [
            {
                "row": number,
                "nx": int(columns["nx"][k]),
                "code": str(columns["gauss_code_chiral"][k]),
                "plain": str(columns["gauss_code"][k]),
                "split": str(columns["split"][k]),
                "knot": str(columns["knot"][k]),
                "q": [_number(values[k]) for _, values in measures.values()],
                "x": _crossings(points[k]),
            }
            for k, number in enumerate(Counts.over(rows, "shapes of the page"))
        ],
    }


def _episodes(
    sources: Sequence[Path], notices: list[str], about: dict[str, Any], replay: Replay | None
) -> dict[str, Any]:
    """Collect episodes of datasets, sampled so that they have at most MOST_FRAMES states."""
    datasets = [columns_of(source, recordings=True) for source in sources]
    every = [(dataset, row) for dataset in datasets for row in range(len(dataset))]
    lengths = np.concatenate([dataset.episodes.episodes["length"] for dataset in datasets]).tolist()
    frames = [min(length, MOST_STEPS) + 1 for length in lengths]
    most = int(len(every) * MOST_FRAMES / max(1, sum(frames))) or 1
    # episodes differ in length, so the first guess may be too many
    while most > 1 and sum(frames[k] for k in _sampled(len(every), most)) > MOST_FRAMES:
        most = min(most, len(every)) - 1
    rows = _sampled(len(every), most, "episodes", notices)
    if any(lengths[k] > MOST_STEPS for k in rows):
        notices.append(f"Longer episodes show their first {MOST_STEPS} steps.")
    about |= {
        "task": as_json(datasets[0].task),
        "datasets": ", ".join(dict.fromkeys(dataset.name for dataset in datasets)),
        "episodes": len(every),
        "steps": sum(lengths),
        **_versions(datasets[0].attributes.get("versions") or {}),
    }
    chosen = [[every[k][1] for k in rows if every[k][0] is dataset] for dataset in datasets]
    parts = [part.select(of) for part, of in zip(datasets, chosen, strict=True) if of]
    if replay:
        parts = [expanded(part, replay) if part.episodes.is_recording else part for part in parts]
    about["by goal"] = _by_goal([part.episodes.episodes for part in parts])
    shown = [(part, row) for part in parts for row in range(len(part))]
    told = Counts.over(shown, "episodes of the page", len(shown))
    return {"episodes": [_episode(*each) for each in told], "beads": datasets[0].task.beads}


def _by_goal(tables: Sequence[Mapping[str, NDArray[Any]]]) -> str:
    """Say how many of the episodes that are shown reached each goal, most failures first."""
    codes = np.concatenate([gauss_codes(table["goal_visits"]) for table in tables])
    success = np.concatenate([table["success"] for table in tables])
    reached, failed = (Counter(codes[rows].tolist()) for rows in (success, ~success))
    order = sorted({*reached, *failed}, key=lambda code: (-failed[code], code))
    return "; ".join(f"{code}: {reached[code]} reached, {failed[code]} failed" for code in order)


def _episode(dataset: EpisodeDataset, row: int) -> dict[str, Any]:
    (rows, steps), first = dataset.episodes, int(dataset.episodes.offsets[row])
    count = min(int(rows["length"][row]), MOST_STEPS) + 1
    pulls, states = slice(first, first + count - 1), slice(first, first + count)
    codes, code = _indexed(gauss_codes(steps["visits"][states]))
    chiral, code_chiral = _indexed(gauss_codes(steps["visits"][states], steps["signs"][states]))
    share = steps["applied_fraction"][pulls].astype(float)
    force = share[:, None] * steps["force"][pulls] * dataset.task.rope_config.max_force
    points = steps["observation"][states].astype(np.float64)
    goal = rows["goal_points"][row].astype(np.float64)
    return {
        "set": dataset.name,
        "name": dataset.name.removeprefix("knotgym/"),
        "number": int(dataset.numbers[row]),
        "policy": str(rows["policy"][row]),
        "goal": str(gauss_codes(rows["goal_visits"][row : row + 1])[0]),
        "split": dataset.task.split,
        "success": bool(rows["success"][row]),
        # as text: a seed can exceed the 53 bits of a JavaScript number
        "seed": "" if rows["seed"][row] < 0 else str(rows["seed"][row]),
        "points": _encoded(points),
        "goal_points": _encoded(goal[None]),
        "goal_x": _crossings(goal),
        "codes": codes,
        "code": code,
        "chiral": chiral,
        "code_chiral": code_chiral,
        "x": [_crossings(rope) for rope in points],
        "bead": [-1, *steps["bead"][pulls].tolist()],
        "force": [[0.0] * 3, *([round(float(n), 4) for n in vector] for vector in force)],
        "applied_share": [1.0, *share.tolist()],
        "rewards": [_number(reward) for reward in steps["reward"][pulls]],
    }


def _indexed(codes: NDArray[np.str_]) -> tuple[list[str], list[int]]:
    """Return the distinct codes, in order of first appearance, and the index of each state's."""
    known: dict[str, int] = {}
    rows = [known.setdefault(str(code), len(known)) for code in codes]
    return list(known), rows


def _crossings(points: Array) -> list[list[float]]:
    """Return over position and under position (in beads) and sign of each crossing."""
    known = find_crossings(points)
    rows = zip(known.over_place.tolist(), known.under_place.tolist(), known.sign, strict=True)
    return [[round(over, 2), round(under, 2), int(sign)] for over, under, sign in rows]


def _encoded(points: Array) -> str:
    """Encode ropes (n, beads, 3), centred at the origin, as little-endian int16 of _UNIT metres."""
    if not np.isfinite(points).all():
        raise InvalidFile("a vertex of a rope to show isn't finite")
    laid = (points - points.mean(axis=1, keepdims=True)) / _UNIT
    limits = np.iinfo(np.int16)
    whole = np.rint(laid).clip(limits.min, limits.max).astype("<i2")
    return base64.b64encode(whole.tobytes()).decode("ascii")


def _picture(stored: Mapping[str, bytes]) -> str:
    return f"data:image/png;base64,{base64.b64encode(stored['bytes']).decode()}"


def _number(value: Any) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None


def _versions(attributes: Mapping[str, Any]) -> dict[str, str]:
    return {name: str(attributes[name]) for name in ("knotgym", "mujoco") if name in attributes}


def _cut(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) < _LONGEST_TEXT else text[:_LONGEST_TEXT] + " ..."
