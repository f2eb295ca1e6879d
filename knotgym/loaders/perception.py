"""Load perception tables as a torch Dataset or a Hugging Face Dataset."""

import os
from typing import Any

from knotgym.common import InvalidInput
from knotgym.loaders.converters import import_client


def images(
    path: str | os.PathLike[str],
    split: str | None = None,
    kind: str = "torch",
    *,
    max_nx: int | None = None,
) -> Any:
    """Load a perception table written by `knotgym images`.

    Args:
        path: the folder, or one shard.
        split: "train", "test", "test-code" or "test-nx"; None for all rows.
        kind: "torch" for a `knotgym.loaders.pytorch.PictureDataset`, which any number of
            DataLoader workers can share; "huggingface" for a `datasets.Dataset`, or a `DatasetDict`
            of all splits if split is None.
        max_nx: pad labels to this number of crossings (torch only); None for the largest in the
            table.

    Raises:
        MissingExtra: torch or Hugging Face's datasets isn't installed.
        InvalidInput: kind is neither of the two.
        InvalidFile: the table has no such split, or a row has more than max_nx crossings.
        MissingFile: nothing exists at path.
    """
    if kind == "torch":
        import_client("torch")
        from knotgym.loaders.pytorch import PictureDataset

        return PictureDataset(path, split, max_nx)
    if kind != "huggingface":
        raise InvalidInput(f"kind must be one of torch, huggingface, got {kind!r}")
    from knotgym.datasets import shards

    library = import_client("datasets")
    files: dict[str, list[str]] = {}
    for shard in shards(path, split):
        files.setdefault(shard.name.partition("-")[0], []).append(str(shard))
    wanted = None if split is None else next(iter(files))
    return library.load_dataset("parquet", data_files=files, split=wanted)
