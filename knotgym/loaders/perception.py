"""Perception tables for learners: a torch Dataset over pictures and padded labels, or Hugging
Face's own.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

from knotgym.loaders.converters import MissingExtra

KINDS = ("torch", "huggingface")


def images(
    path: str | os.PathLike[str],
    split: str | None = None,
    kind: str = "torch",
    *,
    max_nx: int | None = None,
) -> Any:
    """Open what `knotgym images` wrote.

    Args:
        path: the folder, or one shard.
        split: "train", "test", "test-code" or "test-nx"; None for all rows.
        kind: "torch" for a `knotgym.loaders.picture_dataset.PictureDataset`, which any number of
            DataLoader workers may share; "huggingface" for a `datasets.Dataset`, a `DatasetDict` of
            the splits where split is None.
        max_nx: crossings that labels are padded to (torch); None for the table's largest.

    Raises:
        MissingExtra: torch, or Hugging Face's datasets, isn't installed.
        ValueError: no such kind or split, or a row has more than max_nx crossings.
        FileNotFoundError: there is nothing at path.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    if kind == "torch":
        _needed("torch", "Tensor", "torch")
        from knotgym.loaders.picture_dataset import PictureDataset

        return PictureDataset(path, split, max_nx)
    from knotgym.datasets.image_table import shards

    library = _needed("datasets", "load_dataset", "huggingface")
    files: dict[str, list[str]] = {}
    for shard in shards(path, split):
        files.setdefault(shard.name.partition("-")[0], []).append(str(shard))
    return library.load_dataset(
        "parquet", data_files=files, split=None if split is None else split.replace("-", "_")
    )


def _needed(module: str, name: str, extra: str) -> Any:
    """Import a module that has `name`; the link `datasets` of a checkout, found first from its top,
    doesn't.
    """
    how = f"pip install 'knotgym[{extra}]'"
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), how) from error
    if not hasattr(found, name):
        raise MissingExtra(
            module,
            f"{how}; and don't run from the top of a checkout of knotgym, whose folder {module}"
            " hides it",
        )
    return found
