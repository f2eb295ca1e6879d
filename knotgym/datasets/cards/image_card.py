"""The card (README.md) of a perception table, and the tables of facts shown in it."""

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.datasets.cards.citation import filled, plain
from knotgym.datasets.cards.fact_tables import CardTable
from knotgym.datasets.image_table import GRADES, file_stem, read_table, shards
from knotgym.states.splits import IMAGE_SPLITS

_COUNTED = ("gauss_code", "gauss_code_chiral", "split", "grade", "nx", "accepted")


def tables(path: Path) -> dict[str, CardTable]:
    """Return the tables of facts about a perception table by name."""
    rows = read_table(path, columns=[*_COUNTED, "quality"])
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}
    parts = {f"nx {nx}": columns["nx"] == nx for nx in sorted(set(columns["nx"].tolist()))}
    parts |= {name: found for name in IMAGE_SPLITS if (found := columns["split"] == name).any()}
    chosen = {
        part: {name: column[of] for name, column in columns.items()} for part, of in parts.items()
    }
    quality = rows["quality"].combine_chunks().flatten()
    names = [field.name for field in rows.schema.field("quality").type]
    listed = (
        CardTable(
            "counts",
            ("", "pictures", "codes", "chiral", "of a code", "accepted"),
            [(part, *_counts(own)) for part, own in chosen.items()],
            "chiral: codes with chirality; of a code: fewest / most pictures; accepted: within the"
            " quality limits of generated states",
            left=("",),
        ),
        CardTable(
            "splits and grades",
            ("", *IMAGE_SPLITS, *GRADES),
            [
                (
                    part,
                    *(int((own["split"] == name).sum()) for name in IMAGE_SPLITS),
                    *(int((own["grade"] == name).sum()) for name in GRADES),
                )
                for part, own in chosen.items()
            ],
            left=("",),
        ),
        CardTable(
            "quality",
            ("measure", "5 %", "median", "95 %"),
            [
                (name, *(f"{value:.3g}" for value in np.quantile(one, (0.05, 0.5, 0.95))))
                for name, one in zip(names, quality, strict=True)
                if len(one)
            ],
            left=("measure",),
        ),
    )
    return {one.title: one for one in listed}


def card(folder: Path, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Write the card as Markdown, with the YAML front matter that Hugging Face reads.

    Args:
        folder: holds the Parquet files.
        report: numbers of ropes and frames, and of frames not used, by reason.
        config: the configuration of the run.
    """
    rows, files = read_table(folder, columns=["nx", "split"]), shards(folder)
    splits = [name for name in IMAGE_SPLITS if name in set(rows["split"].to_pylist())]
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in splits]
    return filled(
        "image_card.md",
        data_files=[f"  - split: {split}\n    path: {path}" for split, path in paths],
        crossings=", ".join(map(str, sorted(set(rows["nx"].to_pylist())))),
        pictures=len(rows),
        bytes=f"{sum(file.stat().st_size for file in files) / len(rows):.0f}",
        version=knotgym.__version__,
        mujoco=mujoco.__version__,
        engine=config["engine"],
        seed=config["seed"],
        pulls=config["pulls"],
        policies=" and ".join(config["policies"]),
        code_share=f"{config['code_share']:g}",
        test_nx=", ".join(map(str, config["test_nx"] or ())) or "none",
        **{name.replace(" ", "_"): one.markdown() for name, one in tables(folder).items()},
        ropes=report["ropes"],
        frames=report["frames"],
        not_used=plain(json.dumps({**report["dropped"], **report["refused"]})),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def _counts(own: Mapping[str, NDArray[Any]]) -> tuple[object, ...]:
    codes = Counter(own["gauss_code"].tolist())
    return (
        *(len(own["nx"]), len(codes), len(set(own["gauss_code_chiral"].tolist()))),
        f"{min(codes.values())} / {max(codes.values())}",
        int(own["accepted"].sum()),
    )
