"""The card (README.md) of a perception table, and the counts shown in it."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import knotgym
from knotgym.datasets.cards.citation import filled, plain
from knotgym.datasets.cards.fact_tables import image_tables
from knotgym.datasets.image_table import GRADES, file_stem, read_table
from knotgym.states.splits import IMAGE_SPLITS

_TEXT = ("gauss_code", "gauss_code_chiral", "split", "grade")
_COUNTED = (*_TEXT, "nx", "accepted")


def summary(path: str | Path) -> dict[str, Any]:
    """Count codes, grades and accepted pictures of a perception table, by nx and by split.

    The result can be written as JSON; it has the 5 %, 50 % and 95 % quantiles of the measures.
    """
    rows = read_table(path, columns=[*_COUNTED, "quality", "appearance"])
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}

    def counts_by(name: str, order: Iterable[Any]) -> dict[str, Any]:
        found = {str(value): columns[name] == value for value in order}
        return {
            value: _counts({name: column[chosen] for name, column in columns.items()})
            for value, chosen in found.items()
            if chosen.any()
        }

    quality = rows["quality"].to_pylist()
    looks = rows["appearance"].to_pylist()
    sizes = Counter(look["size"] for look in looks)
    return {
        "pictures": len(rows),
        "nx": counts_by("nx", sorted(set(columns["nx"].tolist()))),
        "splits": counts_by("split", IMAGE_SPLITS),
        "quality": {
            name: _spread([measures[name] for measures in quality])
            for name in (quality[0] if quality else ())
        },
        "sizes": {str(size): count for size, count in sorted(sizes.items())},
        "colours": dict(sorted(Counter(look["colours"] for look in looks).items())),
    }


def card(
    facts: Mapping[str, Any], config: Mapping[str, Any], report: Mapping[str, Any], size: int
) -> str:
    """Write the card as Markdown, with the YAML front matter that Hugging Face reads.

    `facts` is the table's `summary`; `report` has the numbers of ropes and frames, and of frames
    not used, by reason; `size` is that of the shards in bytes.
    """
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in facts["splits"]]
    return filled(
        "image_card.md",
        data_files=[f"  - split: {split}\n    path: {path}" for split, path in paths],
        crossings=", ".join(facts["nx"]),
        pictures=facts["pictures"],
        bytes=f"{size / facts['pictures']:.0f}",
        version=knotgym.__version__,
        mujoco=mujoco.__version__,
        engine=config["engine"],
        seed=config["seed"],
        pulls=config["pulls"],
        policies=" and ".join(config["policies"]),
        code_share=f"{config['code_share']:g}",
        test_nx=", ".join(map(str, config["test_nx"] or ())) or "none",
        **{name: one.markdown() for name, one in image_tables(facts).items()},
        ropes=report["ropes"],
        frames=report["frames"],
        not_used=plain(json.dumps({**report["dropped"], **report["refused"]})),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def _counts(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    codes = Counter(columns["gauss_code"].tolist())
    return {
        "pictures": len(columns["nx"]),
        "codes": len(codes),
        "codes_with_chirality": len(set(columns["gauss_code_chiral"].tolist())),
        "of_a_code": [min(codes.values()), max(codes.values())],
        "split": {split: int((columns["split"] == split).sum()) for split in IMAGE_SPLITS},
        "accepted": int(columns["accepted"].sum()),
        "grade": {grade: int((columns["grade"] == grade).sum()) for grade in GRADES},
    }


def _spread(values: list[float]) -> list[float]:
    return [float(np.quantile(values, share)) for share in (0.05, 0.5, 0.95)]
