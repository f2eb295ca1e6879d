"""Photos read by the network that ships: its weights, one photo, and folders of them as a run.

After a change run `pytest -m clients tests/learn/test_rope_weights.py`.
"""

import csv
import hashlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from knotgym.common import (
    InvalidFile,
    InvalidInput,
    MissingFile,
    atomic_write,
    require_apart,
    require_output,
)
from knotgym.learn.card import ROPE_READER
from knotgym.learn.checkpoint import load_network, save_network
from knotgym.learn.learners import policy_folder
from knotgym.learn.train_config import ReadConfig
from knotgym.photos import (
    PhotoReading,
    RopeReader,
    StrandNetwork,
    is_picture,
    open_picture,
    overlay,
)
from knotgym.runs import (
    Call,
    Progress,
    Recipe,
    Result,
    RunOptions,
    compute,
    executor,
    identity,
    run,
)

_COLUMNS = ("file", "rope", "closed", "crossings", "gauss_code", "confidence", "knot")
_WHOLE = ("crossings", "closed", "reason")  # of a picture


def load_rope_reader(name: str = ROPE_READER) -> RopeReader:
    """Load the weights of a reader of ropes: a folder, or ROPE_READER, which ships.

    Raises:
        InvalidFile: as in `load_network`.
    """
    folder, head = policy_folder(name), "head.1.bias"
    return RopeReader(load_network(folder, ROPE_READER, lambda w: StrandNetwork(len(w[head])))[0])


def save_rope_reader(network: StrandNetwork, folder: Path, card: dict[str, Any]) -> None:
    """Write a folder that `load_rope_reader` reads; `card` adds how it was trained."""
    save_network(folder, network.eval(), ROPE_READER, card)


def read_photo(photo: str | Path | NDArray[np.uint8], weights: str = ROPE_READER) -> PhotoReading:
    """Read the ropes of a photo: a file that Pillow opens, or an array.

    Args:
        photo: path; or uint8 (height, width, 3), RGB, or (height, width), grey.
        weights: folder of a reader, or the one that ships.

    Raises:
        InvalidFile: the picture or the weights can't be read.
        InvalidInput: the array isn't a picture.
    """
    picture = open_picture(Path(photo)) if isinstance(photo, str | Path) else photo
    return _reader(weights).read(picture)


_reader: Callable[[str], RopeReader] = cache(load_rope_reader)


def read_photos(
    photos: Sequence[Path],
    config: ReadConfig,
    options: RunOptions,
    *,
    out: Path | None = None,
    overlays: Path | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Read photos and return their rows; a file that can't be read has a reason and no rope.

    Args:
        photos: files, and folders, whose pictures are read, those of folders in them too.
        config: how they are read.
        options: of the run.
        out: .json or .csv file to write; with it an interrupted run can be resumed.
        overlays: folder for a PNG file of each photo, with what was read drawn on top.
        progress: where to show progress.

    Raises:
        InvalidInput: there are no pictures, or `out` is named otherwise.
        MissingFile: there is no such file.
        Occupied: `out` or an overlay exists, or would replace a photo.
    """
    files = _pictures(photos)
    if out is not None and out.suffix not in (".json", ".csv"):
        raise InvalidInput(f"--out must end in .json or .csv, got {out}")
    drawn = [None if overlays is None else overlays / name for name in _names(files)]
    require_apart(out, overlays)
    for png in filter(None, drawn):  # a photo may lie there
        replaces = options.overwrite or options.resume
        require_output(png, folder=False, overwrite=replaces, reads=files)
    if overlays is not None:
        overlays.mkdir(parents=True, exist_ok=True)
    rows = list[dict[str, Any]]()

    def _recipe(place: Path | None) -> Recipe[str]:
        calls = [
            Call(f"photos {k}", _read, (path, config, shown))
            for k, (path, shown) in enumerate(zip(files, drawn, strict=True))
        ]
        rows.extend([json.loads(bytes(result["row"])) for result in (yield calls)])
        if place is not None:
            _write(place, rows)
        return f"{len(rows)} photos read, {sum(bool(row['ropes']) for row in rows)} show a rope"

    if out is None:
        with executor(options.workers, options.scheduler) as pool:
            compute(_recipe(None), pool=pool, progress=progress)
        return rows
    whole = identity(config, {"photos": {str(path): path for path in files}})
    run(_recipe, out, whole, options, progress, is_folder=False, identity_in=lambda _: None)
    return rows


def _pictures(photos: Sequence[Path]) -> list[Path]:
    """Return the files, and the pictures in the folders, in order of their names."""
    files = list[Path]()
    for path in photos:
        if path.is_dir():
            files += sorted(file for file in path.rglob("*") if file.is_file() and is_picture(file))
        elif path.exists():
            files.append(path)
        else:
            raise MissingFile(f"no photo {path}")
    if not files:
        raise InvalidInput(f"no pictures in {', '.join(map(str, photos))}")
    return files


def _names(files: Sequence[Path]) -> list[str]:
    """Name the overlays: as the photo, with a digest of its folder where two have one name."""
    stems = [path.stem for path in files]
    return [
        f"{path.stem}.png" if stems.count(path.stem) == 1
        else f"{path.stem}-{hashlib.sha256(str(path).encode()).hexdigest()[:8]}.png"
        for path in files
    ]  # fmt: skip


def _read(path: Path, config: ReadConfig, shown: Path | None) -> Result:
    """Read one photo: its row as JSON."""
    try:
        picture = open_picture(path)
    except InvalidFile as error:
        row = {**PhotoReading(reason=str(error)).row}
    else:
        reading = _reader(config.weights).read(picture, config.views)
        row = reading.row
        if shown is not None:
            with atomic_write(shown, overwrite=True) as part:
                Image.fromarray(overlay(picture, reading)).save(part, "PNG")
    return {"row": np.frombuffer(json.dumps({"file": str(path), **row}).encode(), np.uint8)}


def _write(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows of photos as JSON; or as CSV, with a line a rope, or one without a rope."""
    if path.suffix == ".json":
        path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        return
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*_COLUMNS, "picture_crossings", "picture_closed", "reason"])
        for row in rows:
            for k, rope in enumerate(row["ropes"] or [{}], 1):
                values = [rope.get(name) for name in _COLUMNS[2:]]
                whole = [row[name] for name in _WHOLE]
                writer.writerow([row["file"], k if rope else None, *values, *whole])
