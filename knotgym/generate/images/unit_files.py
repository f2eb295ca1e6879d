"""Files of the staging folder with units of walks, from which a killed run is resumed."""

from pathlib import Path
from typing import NamedTuple

from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import require_regular
from knotgym.generate.images.walks import Unit, WalkFrames, make_walks
from knotgym.generate.packed_records import FOREIGN, read_records, write_records


class UnitFile(NamedTuple):
    """A unit of walks and its file."""

    path: Path
    unit: Unit


def walked(work: UnitFile) -> Path:
    """Make a unit's walks and write them to its file, unless an intact one exists."""
    try:
        load_frames(work.path)  # the file has checksums
    except (InvalidFile, OSError):
        write_records(work.path, {"frames": [make_walks(work.unit)]})
    return work.path


def load_frames(path: Path) -> WalkFrames:
    """Read a file of `walked`; raise InvalidFile if it is truncated, corrupted or of another
    kind.
    """
    require_regular(path, "walks", InvalidFile)
    try:
        (frames,) = read_records(path, "frames", WalkFrames)
    except FOREIGN as error:
        raise InvalidFile(f"{path} holds no walks of a run: {error}") from error
    return frames
