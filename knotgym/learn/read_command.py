"""The command `knotgym read`."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from knotgym.cli import EXISTING, Given, command
from knotgym.common import MissingExtra
from knotgym.learn.train_config import ReadConfig


@command({"": ReadConfig}, f"views weights run.workers {EXISTING}")
def read(
    given: Given,
    photos: Annotated[list[Path], Parameter(name="PHOTO")],
    /,
    *,
    out: Path | None = None,
    overlay: Path | None = None,
) -> None:
    """Read ropes off photos: crossings, Gauss codes, knot types.

    Needs the extra learn: pip install '.[learn]'.

    Examples:

        knotgym read rope.jpg

        knotgym read photos --out codes.json --overlay seen

    Args:
        photos: Pictures, and folders of them; any format that Pillow reads.
        out: JSON or CSV file to write, as its name ends.
        overlay: Folder for a picture of each photo with what was read drawn on it.
    """
    for library in ("torch", "safetensors"):
        MissingExtra.imported(library, "learn", "knotgym read")
    from knotgym.learn.rope_weights import read_photos

    progress = given.progress
    config = given.config(ReadConfig)
    rows = read_photos(photos, config, given.run, out=out, overlays=overlay, progress=progress)
    for row in rows:
        progress.console.print(_said(row), soft_wrap=True, highlight=False, markup=False)


def _said(row: dict[str, Any]) -> str:
    """Say in a line what a photo shows."""
    ropes = [
        f"{'closed' if rope['closed'] else 'open'} rope, {rope['crossings']} crossings"
        f"{', ' + rope['knot'] if rope['knot'] else ''}: {rope['gauss_code'] or 'plain'}"
        f" ({rope['confidence']:.2f})"
        for rope in row["ropes"]
    ]
    return f"{row['file']}: {'; '.join([*ropes, *filter(None, [row['reason']])])}"
