"""What goes beside the shards of a perception table: the walks, the card and the manifest; and what
is in such a folder.

`walks.h5` holds the states that walks set out from and the pulls of every walk that a row comes
from, so that each configuration can be made again without the archive.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np

import knotgym
from knotgym.atomic_files import atomic_write, new_hdf5, sha256
from knotgym.datasets.image_table import GRADES, SPLITS, read_table
from knotgym.generate.images.seed_states import SeedStates
from knotgym.generate.images.walks import Frames
from knotgym.rope import RopeConfig

WALKS_FORMAT = "knotgym-walks"
WALKS_VERSION = 1


def finish(
    folder: Path,
    shards: Sequence[Path],
    request: Mapping[str, Any],
    report: Mapping[str, Any],
    start: SeedStates,
    walks: Sequence[Frames],
) -> None:
    """Write walks, card and manifest into a folder whose shards are written; the manifest comes
    last.
    """
    used = set(
        np.concatenate([np.asarray(_sources(path), dtype=np.int64) for path in shards]).tolist()
    )
    write_walks(folder / "walks.h5", start, walks, used)
    close(folder, shards, request, report)


def close(
    folder: Path, shards: Sequence[Path], request: Mapping[str, Any], report: Mapping[str, Any]
) -> None:
    """Write card and manifest into a folder that has everything else."""
    facts = summary(folder)
    text = card(facts, request["config"], report, sum(path.stat().st_size for path in shards))
    with atomic_write(folder / "README.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    manifest = {
        "format": "knotgym-images-manifest",
        "format_version": 2,
        **request,
        "report": report,
        "summary": facts,
        "files": {
            str(path.relative_to(folder)): sha256(path)
            for path in sorted(folder.rglob("*"))
            if path.is_file() and path.name != "manifest.json"
        },
    }
    with atomic_write(folder / "manifest.json") as temporary:
        temporary.write_text(json.dumps(manifest, indent=1, sort_keys=True), encoding="utf-8")


def write_walks(path: Path, start: SeedStates, walks: Sequence[Frames], used: set[int]) -> None:
    """Write the walks whose numbers are used, and the states they set out from."""
    rows = [
        (number, unit, row)
        for unit in walks
        for row, number in enumerate(unit.numbers.tolist())
        if number in used
    ]
    bases, at = np.unique([unit.bases[row] for _, unit, row in rows], return_inverse=True)
    # shorter walks end with pulls of no force, which no row looks at
    longest = max(unit.beads.shape[1] for _, unit, _ in rows)
    pulls = {
        name: np.stack([_padded(getattr(unit, name)[row], longest) for _, unit, row in rows])
        for name in ("beads", "forces")
    }
    numbers = np.array([number for number, _, _ in rows], dtype=np.int64)
    _write_walks(
        path,
        {"state": start.states[bases], "number": numbers, "start": at.astype(np.int64), **pulls},
    )


def join_walks(path: Path, sources: Sequence[Path]) -> None:
    """Write the walks of several such files, whose numbers differ, into one."""
    columns: dict[str, list[np.ndarray]] = {
        name: [] for name in ("state", "number", "start", "beads", "forces")
    }
    for source in sources:
        with h5py.File(source, "r") as file:
            before = sum(map(len, columns["state"]))
            for name, parts in columns.items():
                parts.append(file[name][()] + (before if name == "start" else 0))
    longest = max(beads.shape[1] for beads in columns["beads"])
    for name in ("beads", "forces"):
        columns[name] = [
            np.stack([_padded(pulls, longest) for pulls in part]) for part in columns[name]
        ]
    _write_walks(path, {name: np.concatenate(parts) for name, parts in columns.items()})


def _write_walks(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    squeezed = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    with atomic_write(path) as temporary, new_hdf5(temporary) as file:
        file.attrs["format"], file.attrs["format_version"], file.attrs["rope"] = (
            WALKS_FORMAT,
            WALKS_VERSION,
            RopeConfig().fingerprint,
        )
        for name, column in columns.items():
            file.create_dataset(
                name, data=column, **({} if name in ("number", "start") else squeezed)
            )


def summary(path: str | Path) -> dict[str, Any]:
    """Counts of a perception table, JSON-able: by nx and split; codes, grades, accepted pictures,
    the spread of the measures.
    """
    table = read_table(
        path,
        columns=[
            "gauss_code",
            "gauss_code_chiral",
            "nx",
            "split",
            "accepted",
            "grade",
            "quality",
            "appearance",
        ],
    )
    columns = {
        name: np.array(table[name].to_pylist())
        for name in ("gauss_code", "gauss_code_chiral", "nx", "split", "accepted", "grade")
    }
    out: dict[str, Any] = {"pictures": len(table), "nx": {}, "splits": {}}
    for nx in sorted(set(columns["nx"].tolist())):
        out["nx"][str(nx)] = _counts(
            {name: column[columns["nx"] == nx] for name, column in columns.items()}
        )
    for split in SPLITS:
        if (columns["split"] == split).any():
            out["splits"][split] = _counts(
                {name: column[columns["split"] == split] for name, column in columns.items()}
            )
    quality: dict[str, list[float]] = {}
    for row in table["quality"].to_pylist():
        for name, value in row.items():
            quality.setdefault(name, []).append(value)
    out["quality"] = {
        name: [float(np.quantile(values, share)) for share in (0.05, 0.5, 0.95)]
        for name, values in quality.items()
    }
    looks = table["appearance"].to_pylist()
    out["sizes"] = {
        str(size): count for size, count in sorted(Counter(look["size"] for look in looks).items())
    }
    out["colours"] = dict(sorted(Counter(look["colours"] for look in looks).items()))
    return out


def card(
    facts: Mapping[str, Any], config: Mapping[str, Any], report: Mapping[str, Any], size: int
) -> str:
    """The card as Markdown, with the YAML head that Hugging Face reads; `size` is that of all
    shards, bytes.
    """
    head = [
        "pictures",
        "codes",
        "with chirality",
        "fewest / most of a code",
        *SPLITS,
        "accepted",
        *GRADES,
    ]
    by_nx = [_row(nx, *_cells(one)) for nx, one in facts["nx"].items()]
    by_split = [_row(split, *_cells(one)) for split, one in facts["splits"].items()]
    files = [
        f"  - split: {split.replace('-', '_')}\n    path: data/{split.replace('-', '_')}-*.parquet"
        for split in facts["splits"]
    ]
    return "\n".join(
        [
            "---",
            "license: mit",
            "tags: [knot-theory, gauss-code, mujoco, perception]",
            "task_categories: [image-to-text]",
            "configs:",
            "- config_name: default",
            "  data_files:",
            *files,
            "---",
            "",
            f"# Pictures of ropes with {', '.join(facts['nx'])} crossings, and their Gauss codes",
            "",
            (
                f"{facts['pictures']} pictures of a closed rope, {size / facts['pictures']:.0f}"
                f" bytes each with all labels, made by `knotgym images` {knotgym.__version__}"
                f" (MuJoCo {mujoco.__version__}) with seed {config['seed']}. `load_dataset(FOLDER)`"
                " of Hugging Face's datasets and `knotgym.loaders.images(FOLDER)` read them;"
                " `knotgym dataset verify FOLDER` recomputes every label, measure and picture and"
                " makes every walk again."
            ),
            "",
            "## What a row holds",
            "",
            (
                '`image`: PNG, lossless. `gauss_code`, `gauss_code_chiral`: "1+,1-,2+,2-",'
                ' "1+a,1-a,2+c,2-c", the walk from the white base bead towards red. `nx`:'
                " crossings. `knot`: type. `points`: 300 float64, bead by bead, metres."
                " `crossings`: pixel x (right), y (down) of each, the places of the over and the"
                " under strand along the rope (beads, 2.25 is a quarter from bead 2 to bead 3), its"
                " sign; in order of first visit. `quality`: the measures of the configuration in"
                " the published 128 x 128 picture, whatever the row's own. `accepted`: it keeps to"
                " all limits of curated states. `grade`: how hard it is to read, by its worst"
                " measure in units of the limit for accepted states: easy from 1.5, medium from 1,"
                " hard from 0.5, extreme below. `appearance`: how it was drawn. `source`: the walk"
                " in `walks.h5`, pulls made, rounds of opening up, and the symmetry applied then."
            ),
            "",
            (
                'With colours "single" a picture shows the base bead and not the direction of the'
                " walk: the code of the reversed walk fits it too."
            ),
            "",
            "## Splits",
            "",
            (
                "train and test differ in configuration: everything made from one state, its"
                " near-duplicates and their mirror images, reversals and renumberings stays in one"
                " split (walks from the plain loop are each on their own), and no two rows"
                " anywhere are near-duplicates. test-code shows codes that no other split but"
                f" test-nx shows, a share of {config['code_share']:g} of the codes with at least 2"
                " crossings. test-nx shows more crossings than training,"
                f" {', '.join(map(str, config['test_nx'])) or 'none'}."
            ),
            "",
            _row("nx", *head),
            _row(*["---"] * (len(head) + 1)),
            *by_nx,
            "",
            _row("split", *head),
            _row(*["---"] * (len(head) + 1)),
            *by_split,
            "",
            "## Quality",
            "",
            "| measure | 5 % | median | 95 % |",
            "| --- | --- | --- | --- |",
            *(
                _row(name, *(f"{value:.3g}" for value in spread))
                for name, spread in facts["quality"].items()
            ),
            "",
            "## How to make it again",
            "",
            (
                f"{report['walks']} walks met {report['frames']} frames. Not taken:"
                f" {json.dumps({**report['dropped'], **report['refused']})}."
            ),
            "",
            "```json",
            json.dumps(config, indent=1, sort_keys=True),
            "```",
            "",
        ]
    )


def _padded(pulls: np.ndarray, longest: int) -> np.ndarray:
    return np.pad(pulls, [(0, longest - len(pulls)), *[(0, 0)] * (pulls.ndim - 1)])


def _sources(path: Path) -> list[int]:
    return [row["walk"] for row in read_table(path, columns=["source"])["source"].to_pylist()]


def _counts(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    codes = Counter(columns["gauss_code"].tolist())
    return {
        "pictures": len(columns["nx"]),
        "codes": len(codes),
        "codes_with_chirality": len(set(columns["gauss_code_chiral"].tolist())),
        "of_a_code": [min(codes.values()), max(codes.values())],
        "split": {split: int((columns["split"] == split).sum()) for split in SPLITS},
        "accepted": int(columns["accepted"].sum()),
        "grade": {grade: int((columns["grade"] == grade).sum()) for grade in GRADES},
    }


def _cells(one: Mapping[str, Any]) -> list[object]:
    fewest, most = one["of_a_code"]
    own = [one["pictures"], one["codes"], one["codes_with_chirality"], f"{fewest} / {most}"]
    return [
        *own,
        *(one["split"][split] for split in SPLITS),
        one["accepted"],
        *(one["grade"][grade] for grade in GRADES),
    ]


def _row(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"
