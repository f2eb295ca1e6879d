"""Cards (README.md) of folders of states and of pictures, and the tables of facts in them."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import knotgym
from knotgym.datasets.cards import (
    CardTable,
    code_span,
    counted,
    filled_template,
    measured,
    plain,
    table,
    write_text,
)
from knotgym.datasets.cards.croissant import write_croissant
from knotgym.datasets.gallery import state_tiles, write_gallery
from knotgym.datasets.image_table import file_stem, marks_base, read_table, shards
from knotgym.datasets.located import Located
from knotgym.datasets.manifest import read_manifest, write_manifest
from knotgym.quality import GRADES, Quality
from knotgym.rendering import APPEARANCES
from knotgym.states import IMAGE_SPLITS, SOURCES, STATE_SPLITS, States, read_states
from knotgym.topology import GaussCode

_COUNTED = ("gauss_code", "gauss_code_chiral", "split", "grade", "nx", "accepted")
_SPLITS = {name: ("split", name) for name in IMAGE_SPLITS}
_GRADES = {name: ("grade", name) for name in GRADES} | {"accepted": ("accepted", True)}
# what test-code holds out
_MARKED = "Codes are compared as they are read from the base bead; another base is another code."
_UNMARKED = (
    "Some pictures mark neither base nor direction and fit every code of their diagram. So codes"
    " are compared up to base, direction, mirror images and switched crossings (`canonical_code`)."
)


def summary(found: Located) -> tuple[list[str], dict[str, CardTable]]:
    """Return what states or pictures are, in lines, and the tables of facts about them by name."""
    if found.pictures:
        size = sum(shard.stat().st_size for shard in shards(found.pictures))
        count = len(read_table(found.pictures, columns=["nx"]))
        lines = [f"{count} pictures, {size / count:.0f} bytes each"]
        return lines, _image_tables(found.pictures)
    states = read_states(found.states, images=False)
    made = sorted(Counter(states.source.get("policy", np.empty(0, str)).tolist()).items())
    lines = [f"{len(states)} states"]
    lines += [f"sources: {', '.join(f'{policy} {count}' for policy, count in made)}"] * bool(made)
    report = read_manifest(found.folder)[0].get("report", {})
    return lines, _state_tables(states, report)


def _state_tables(states: States, report: Mapping[str, Any]) -> dict[str, CardTable]:
    """Return the tables of facts about states by name.

    `report` is that of the manifest; {} for states without one.
    """
    numbers = sorted(set(states.nx.tolist()))
    existing = report.get("existing_codes", {})
    rejected = [
        (nx, reason, count)
        for nx, reasons in report.get("rejected", {}).items()
        for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    ]
    found = counted("states", states.table, {name: ("split", name) for name in STATE_SPLITS})
    listed = (
        found._replace(
            head=(*found.head, "of", "c / a"),
            rows=[
                (*row, *_more(states, nx, existing))
                for nx, row in zip(numbers, found.rows, strict=True)
            ],
            says=f"{found.says}; of: existing codes; c / a: positive and negative crossings",
        ),
        CardTable(
            "train and test",
            ("nx", "test states", "code in train", "diagram in train", "nearest, mm"),
            [_overlap(states, nx) for nx in numbers],
            "code in train: test states whose code (without chirality) some train state has;"
            " diagram in train: test states whose code some train state has up to symmetry (another"
            " base bead, the other direction, mirrored or switched); nearest: the smallest distance"
            " from a test state to a train state of any nx, root mean square over the beads,"
            " minimized over those symmetries and rotations about z",
        ),
        CardTable(
            "spread",
            ("nx", "apart", "shapes", "gyration", "height", "visits", "bare"),
            [_spread(states, nx) for nx in numbers],
            "apart: mm, median / min distance of two states (root mean square over the beads, after"
            " the best rotation about z); shapes: the same, minimized over base bead and direction"
            " too; gyration: mm, min / max radius of gyration; height: mm, min / max from the"
            " lowest to the highest bead; visits: beads, mean distance along the rope between"
            " crossings of two states, 25 for random positions; bare: beads, longest stretch where"
            " no state has a crossing",
        ),
        measured(states.measures),
        CardTable(
            "rejected",
            ("nx", "reason", "rejected"),
            rejected,
            f"{report.get('attempts')} drawings or ropes were tried; one can have several reasons",
            left=("reason",),
        ),
    )
    return {one.title: one for one in listed}


def finish_states(
    folder: Path, states: States, report: Mapping[str, Any], request: Mapping[str, Any]
) -> None:
    """Write gallery, card and manifest into a folder that has the states and demonstrations.

    Args:
        report: the run's counts: source, existing codes, rejections, demonstrations.
        request: what was asked for: configuration, sources, versions.
    """
    write_gallery(folder / "gallery.png", state_tiles(states))
    write_text(folder / "README.md", _state_card(states, report, request["config"]))
    write_manifest(folder, "knotgym-manifest", request, report)


def _state_card(states: States, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    found = {name: one.markdown() for name, one in _state_tables(states, report).items()}
    lacking = ", ".join(code_span(code or "loop") for code in report.get("undemonstrated", []))
    return filled_template(
        "state_card.md",
        crossings=", ".join(map(str, sorted(set(states.nx.tolist())))),
        count=len(states),
        knot=plain(report["knot"]),
        version=report["version"],
        mujoco=report["mujoco"],
        engine=states.engine,
        seed=config["seed"],
        source=plain(report["source"]),
        sources="\n".join(
            f"- `{name}`: {SOURCES[name].doc}"
            for name in np.unique(states.source["policy"]).tolist()
        ),
        passed=sum(map(len, report.get("passed_over", {}).values())),
        demonstrations=report.get("demonstrations", 0),
        lacking=lacking and f"The expert reached no goal of these codes: {lacking}.",
        **{name.replace(" ", "_"): text for name, text in found.items()},
        columns=states.table.schema.page(),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def _more(states: States, nx: int, existing: Mapping[str, Any]) -> tuple[object, ...]:
    codes = states.gauss_code_chiral[states.nx == nx].tolist()
    signs = [sign for code in codes for sign in GaussCode.parse(code).signs]
    return existing.get(str(nx), "?") or "many", f"{signs.count(1)} / {signs.count(-1)}"


def _overlap(states: States, nx: int) -> tuple[object, ...]:
    found = states.overlap(nx)
    near = "-" if found["nearest"] is None else f"{1000 * found['nearest']:.1f}"
    return nx, found["test_states"], found["code_in_train"], found["diagram_in_train"], near


def _spread(states: States, nx: int) -> tuple[object, ...]:
    found = states.spread(nx)
    lengths = (found[name] or () for name in ("distance", "shape", "gyration", "height"))
    beads = (found[name] for name in ("visits", "bare"))
    return (
        nx,
        *(" / ".join(f"{round(1000 * one, 1):.3g}" for one in pair) or "-" for pair in lengths),
        *("-" if one is None else f"{one:.1f}" for one in beads),
    )


def _image_tables(path: Path) -> dict[str, CardTable]:
    """Return the tables of facts about a perception table by name."""
    rows = read_table(path, columns=[*_COUNTED, "quality"])
    quality = rows["quality"].combine_chunks()
    measures = {
        field.name: (Quality.UNITS.get(field.name, ""), quality.field(field.name).to_numpy())
        for field in quality.type
    }
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}
    counts = [counted("splits", columns, _SPLITS), counted("grades", columns, _GRADES)]
    return {one.title: one for one in (*counts, measured(measures))}


def finish_images(folder: Path, report: Mapping[str, Any], request: Mapping[str, Any]) -> None:
    """Write card, Croissant and manifest into a folder that has its Parquet files.

    Args:
        folder: holds the Parquet files.
        report: numbers of ropes and frames, and of frames not used, by reason.
        request: what was asked for: configuration, sources, versions.
    """
    config = request["config"]
    write_text(folder / "README.md", _image_card(folder, report, config))
    appearance = config["appearance"]["name"]
    nx = ", ".join(map(str, config["nx"]))
    write_croissant(
        folder,
        f"knotgym-pictures-{appearance}",
        f"Pictures of a closed rope with {nx} crossings and their Gauss codes; made by knotgym.",
        appearance,
    )
    write_manifest(folder, "knotgym-images-manifest", request, report)


def _image_card(folder: Path, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    name = config["appearance"]["name"]
    rows, files = read_table(folder, columns=["nx", "split", "appearance"]), shards(folder)
    splits = [name for name in IMAGE_SPLITS if name in set(rows["split"].to_pylist())]
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in splits]
    return filled_template(
        "image_card.md",
        data_files=[f"  - split: {split}\n    path: {path}" for split, path in paths],
        crossings=", ".join(map(str, sorted(set(rows["nx"].to_pylist())))),
        pictures=len(rows),
        bytes=f"{sum(file.stat().st_size for file in files) / len(rows):.0f}",
        version=knotgym.__version__,
        mujoco=mujoco.__version__,
        engine=config["engine"],
        appearance=f"`{name}`, {APPEARANCES[name].says}",
        seed=config["seed"],
        pulls=config["pulls"],
        policies=" and ".join(config["policies"]),
        code_share=f"{config['code_share']:g}",
        held=_MARKED if marks_base(rows) else _UNMARKED,
        test_nx=", ".join(map(str, config["test_nx"] or ())) or "none",
        **{name: one.markdown() for name, one in _image_tables(folder).items()},
        ropes=report["ropes"],
        frames=report["frames"],
        not_used=plain(json.dumps({**report["dropped"], **report["refused"]})),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def suite_card(report: Mapping[str, Any], references: Sequence[Sequence[object]]) -> str:
    """Return the card of the benchmark as Markdown.

    Args:
        report: the content of suite.json.
        references: states and engine, set-up, random, expert and episodes of each score.
    """
    sets = report["sets"]
    columns = "id states split engine policy seed episodes steps starts goals pairs".split()
    head = (*columns, "reached, %", "MB", "as recorded", "SHA-256 of starts and pulls")
    rows = []
    for name, one in sorted(sets.items()):
        size, digest = f"{one['bytes'] / 1e6:.1f}", f"`{one['sha256'][:16]}...`"
        own = (plain(one[key]) for key in columns[1:])
        share = f"{100 * one['succeeded'] / max(one['episodes'], 1):.1f}"
        reached = "" if one["endless"] else share
        rows.append((code_span(name), *own, reached, size, plain(one["recorded"]), digest))
    return filled_template(
        "suite_card.md",
        count=len(sets),
        episodes=sum(one["episodes"] for one in sets.values()),
        steps=sum(one["steps"] for one in sets.values()),
        version=report["knotgym"],
        seed=report["seed"],
        sets=table(head, rows),
        references=table(
            ("states and engine", "set-up", "random", "expert", "episodes"), references
        ),
    )
