"""What the three kinds of `rows_of_datasets` have in common: columns, ids, outputs, provenance."""

import json
from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import atomic_write, require_output, sha256
from knotgym.common.errors import InvalidInput, one_line
from knotgym.datasets.manifest_check import read_manifest
from knotgym.states.split_names import STATE_SPLITS

Rows = NDArray[np.int64]


class Destination(NamedTuple):
    """Where a selection is written: a file or folder, or for `dataset_id` a root of Minari's."""

    out: str | Path | None = None
    dataset_id: str = ""
    overwrite: bool = False


class RowsOfDataset(ABC):
    """A dataset to select from.

    Attributes:
        source: as it was given.
        path: of the file or folder.
        columns: name -> one value per row.
        ids: int64 (n,), how `delete` names the rows.
    """

    splits: Sequence[str] = STATE_SPLITS

    def __init__(self, source: str | Path, path: Path) -> None:
        self.source, self.path = str(source), path

    @property
    @abstractmethod
    def columns(self) -> dict[str, NDArray[Any]]: ...
    @property
    @abstractmethod
    def ids(self) -> NDArray[np.int64]: ...
    @abstractmethod
    def keys(self) -> list[list[Hashable]]:
        """Return for each row what it shares with rows that must stay in the same part."""

    @abstractmethod
    def digested(self) -> Path:
        """Return the file whose checksum identifies the source."""

    @abstractmethod
    def _write(self, rows: Rows, made: list[dict[str, Any]], path: Path) -> None:
        """Write the rows to `path`, which is renamed afterwards."""

    @property
    def count(self) -> int:
        return len(self.ids)

    def in_split(self, split: str) -> NDArray[np.bool_]:
        if split not in self.splits:
            raise InvalidInput(f"no split {split!r}; splits are {', '.join(self.splits)}")
        return np.asarray(self.columns["split"] == split)

    def earlier(self) -> list[dict[str, Any]]:
        """Return the selections by which the source itself was made."""
        found = read_manifest(self.path)[0].get("selection", []) if self.path.is_dir() else []
        return found if isinstance(found, list) else []

    def require_target(self, target: Destination) -> None:
        if target.dataset_id:
            raise InvalidInput("an id is for episodes; give --out for states and pictures")
        if target.out is None:
            raise InvalidInput("give an output, --out")
        require_output(target.out, folder=self.path.is_dir(), overwrite=target.overwrite)

    def write(self, rows: Rows, how: Mapping[str, Any], target: Destination) -> Path:
        """Write some rows, at least one, as a new dataset; return its path."""
        if not len(rows):
            raise InvalidInput(f"none of the {self.count} rows of {self.source} is left")
        self.require_target(target)
        made = {
            "from": self.source,
            "sha256": sha256(self.digested()),
            "rows": self.count,
            "kept": len(rows),
            **how,
            "knotgym": knotgym.__version__,
        }
        return self._placed(rows, [*self.earlier(), made], target)

    def _placed(self, rows: Rows, made: list[dict[str, Any]], target: Destination) -> Path:
        assert target.out is not None
        with atomic_write(target.out, overwrite=target.overwrite) as path:
            try:
                self._write(rows, made, path)
            except (LookupError, TypeError, AttributeError) as error:
                raise InvalidInput(
                    f"{self.source} has a manifest that knotgym didn't write: {one_line(error)}"
                ) from error
        return Path(target.out)


def selection_sentence(made: Mapping[str, Any]) -> str:
    """Say in a card how a dataset was selected."""
    how = {
        name: value
        for name, value in made.items()
        if name not in ("from", "rows", "kept", "sha256", "knotgym")
    }
    return (
        f"{made['kept']} of the {made['rows']} rows of {Path(made['from']).name}"
        f" (SHA-256 {made['sha256']}), selected by {json.dumps(how, sort_keys=True)}."
    )


def with_selection(text: str, made: Sequence[Mapping[str, Any]]) -> str:
    lines = "\n".join(f"{number}. {selection_sentence(one)}" for number, one in enumerate(made, 1))
    says = "Counts of the run that made the data are those of the first source."
    return f"{text.rstrip()}\n\n## Selection\n\n{says}\n\n{lines}\n"


def json_list(text: Any) -> list[dict[str, Any]]:
    found = json.loads(str(text))
    return found if isinstance(found, list) else []
