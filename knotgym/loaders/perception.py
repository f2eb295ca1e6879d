"""Perception tables for learners: torch's Dataset over pictures and labels, or Hugging Face's."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any

from knotgym.errors import MissingExtra, install_command
from knotgym.loaders.converters import UnknownKind

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
        UnknownKind: there is no such kind.
        InvalidImages: no such split, or a row has more than max_nx crossings.
        MissingFile: there is nothing at path.
    """
    if kind not in KINDS:
        raise UnknownKind(kind, KINDS)
    if kind == "torch":
        _needed("torch", "torch")
        from knotgym.loaders.picture_dataset import PictureDataset

        return PictureDataset(path, split, max_nx)
    from knotgym.datasets.image_table import file_stem, shards  # here, for it needs OpenCV

    library = _needed("datasets", "huggingface")
    files: dict[str, list[str]] = {}
    for shard in shards(path, split):
        files.setdefault(shard.name.partition("-")[0], []).append(str(shard))
    wanted = None if split is None else file_stem(split)
    return library.load_dataset("parquet", data_files=files, split=wanted)


def _needed(module: str, extra: str) -> Any:
    """Import a module of another project, past the links at the top of a checkout of ours."""
    searched, link = list(sys.path), ("knotgym", module)
    sys.path[:] = [one for one in searched if (Path(one) / module).resolve().parts[-2:] != link]
    try:
        imported = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), install_command(extra)) from error
    finally:
        sys.path[:] = searched
    return imported
