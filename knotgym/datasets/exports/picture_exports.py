"""Export pictures for vision tools: COCO (photos alone) and WebDataset.

    SPLIT.json            COCO: rope, strands and crossings of split/000000.png, ...
    SPLIT-000000.tar      WebDataset: 000000.png, 000000.strands.png (photos), 000000.json, ...

In COCO a strand is a piece of rope between two visits of crossings, `edge` its number in the PD
code. A crossing has 17 keypoints, as many as COCO's default scoring takes: itself, and on both of
its strands four points before and four behind it, a quarter of a bead apart. Masks are run lengths
that pycocotools reads; a crossing's is the square around it.
"""

import io
import json
import tarfile
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import Counts, InvalidInput
from knotgym.datasets.episode_verification import Replay
from knotgym.datasets.image_table import file_stem, read_rows, read_table
from knotgym.datasets.located import Located
from knotgym.datasets.png import decode
from knotgym.states import IMAGE_SPLITS

_PER_SHARD = 1000  # most pictures in a tar file
_SHARDS = 16  # tar files of a split, about, at least
# beads from a crossing along a strand; with the crossing itself 17 keypoints, see above
_ALONG = {
    f"{side}_{4 * abs(at):.0f}": at * (1 if side == "behind" else -1)
    for side in ("before", "behind")
    for at in (0.25, 0.5, 0.75, 1.0)
}
_KEYPOINTS = ("crossing", *(f"{strand}_{name}" for strand in ("over", "under") for name in _ALONG))
# scoring asks for them
_NO_KEYPOINTS = {"keypoints": [0] * (3 * len(_KEYPOINTS)), "num_keypoints": 0}
_CATEGORIES = [
    {"id": 1, "name": "rope", "supercategory": "rope"},
    {"id": 2, "name": "strand", "supercategory": "rope"},
    {"id": 3, "name": "crossing", "supercategory": "rope", "keypoints": [*_KEYPOINTS]}
    | {"skeleton": [[1, k] for k in range(2, len(_KEYPOINTS) + 1)]},
]
_LICENCE = {"id": 1, "name": "CC BY 4.0", "url": "https://creativecommons.org/licenses/by/4.0/"}
_TOLD = ("gauss_code_chiral", "canonical_code", "pd_code", "dt_code", "nx", "knot", "photo")


def to_coco(source: Located, folder: Path, _: Replay) -> str:
    """Write photos and their annotations, a folder and a file for each split.

    Raises:
        InvalidInput: the pictures aren't photos, which alone have masks.
    """
    counts = {"images": 0, "annotations": 0}
    for split, _count, rows in _splits(source):
        about = {"description": source.title, "version": knotgym.__version__}
        coco: dict[str, Any] = {"info": about, "licenses": [_LICENCE], "categories": _CATEGORIES}
        coco |= {"images": [], "annotations": []}
        (folder / split).mkdir()
        for number, row in enumerate(rows):
            if "photo" not in row:
                raise InvalidInput(f"{source.title} has no masks for COCO, which photos have")
            name, size = f"{split}/{number:06d}.png", row["appearance"]["size"]
            (folder / name).write_bytes(row["image"])
            facts = {name: row[name] for name in _TOLD}
            picture = {"id": number, "file_name": name, "width": size, "height": size, "license": 1}
            coco["images"].append(picture | facts)
            for annotation in _annotations(row):
                place = {"id": len(coco["annotations"]) + 1, "image_id": number}
                coco["annotations"].append(place | annotation)
        (folder / f"{split}.json").write_text(_json(coco), encoding="utf-8")
        counts = {name: counts[name] + len(coco[name]) for name in counts}
    return f"{counts['images']} pictures, {counts['annotations']} annotations"


def to_webdataset(source: Located, folder: Path, _: Replay) -> str:
    """Write pictures as tar files in the order of their rows, 16 or more if there are as many."""
    total = 0
    for split, count, rows in _splits(source):
        # a loader's worker takes whole files
        done, each = 0, min(_PER_SHARD, -(-count // _SHARDS))
        while few := [*islice(rows, each)]:
            with tarfile.open(folder / f"{split}-{done // each:06d}.tar", "w") as tar:
                for number, row in enumerate(few, done):
                    for end, data in _sample(row).items():
                        entry = tarfile.TarInfo(f"{number:06d}.{end}")
                        entry.size = len(data)
                        tar.addfile(entry, io.BytesIO(data))
            done += len(few)
        total += done
    return f"{total} pictures"


def _json(value: Any) -> str:
    """Write JSON; a measure that is infinite, such as the margin of a plain loop, is null."""
    return json.dumps(json.loads(json.dumps(value), parse_constant=lambda infinity: None))


def _sample(row: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of a picture, by the ends of their names."""
    facts = {name: value for name, value in row.items() if name not in ("image", "strands")}
    files = {"png": row["image"], "json": _json(facts).encode()}
    return files | ({"strands.png": row["strands"]} if "strands" in row else {})


def _splits(source: Located) -> Iterator[tuple[str, int, Iterator[dict[str, Any]]]]:
    """Yield the name of each split, as in file names, how many rows it has, and these."""
    assert source.pictures is not None
    splits = read_table(source.pictures, columns=["split"])["split"].to_pylist()
    counts = Counter(map(file_stem, splits))
    for split in IMAGE_SPLITS:
        if count := counts[name := file_stem(split)]:
            rows = read_rows(source.pictures, split)
            yield name, count, Counts.over(rows, f"writing pictures of {name}", count)


def _annotations(row: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield rope, strands and crossings."""
    strands = decode(row["strands"])[..., 0]
    for strand in (0, *(box["strand"] for box in row["boxes"])):
        mask = strands == strand if strand else strands > 0
        y, x = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
        if not len(y):
            continue  # an occluder hides all of it
        box = [int(x[0]), int(y[0]), int(x[-1] - x[0] + 1), int(y[-1] - y[0] + 1)]
        annotation = {"category_id": 2, "edge": strand} if strand else {"category_id": 1}
        yield annotation | _region(mask) | _NO_KEYPOINTS | {"bbox": box}
    line = np.reshape(row["line"], (-1, 3))[:, :2]
    reach = float(row["photo"]["rope_width"])
    for crossing in row["crossings"]:
        x, y = crossing["x"], crossing["y"]
        points = [(x, y)]
        for place in (crossing["over_place"], crossing["under_place"]):
            for at in (place + beads for beads in _ALONG.values()):
                index, part = int(np.floor(at)) % len(line), at % 1
                here, after = line[index], line[(index + 1) % len(line)]
                points.append(tuple((here + part * (after - here)).tolist()))
        around: list[float] = [x - reach, y - reach, 2 * reach, 2 * reach]
        keypoints = [value for point in points for value in (*point, 2)]
        square = np.zeros(strands.shape, dtype=bool)
        left, right, top, bottom = (max(0, round(n + s * reach)) for n in (x, y) for s in (-1, 1))
        square[top : bottom + 1, left : right + 1] = True
        annotation = {"category_id": 3, "sign": crossing["sign"], **_region(square)}
        annotation |= {"keypoints": keypoints, "num_keypoints": len(points)}
        yield annotation | {"bbox": around, "area": 4 * reach**2}


def _region(mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Return a mask as run lengths, column by column, beginning with background."""
    flat = mask.ravel(order="F")
    ends = np.flatnonzero(np.diff(flat, prepend=False, append=~flat[-1]))
    region = {"size": [*mask.shape], "counts": _compressed(np.diff(ends, prepend=0).tolist())}
    return {"area": int(mask.sum()), "iscrowd": 0, "segmentation": region}


def _compressed(counts: list[int]) -> str:
    """Return run lengths as pycocotools' `rleToString` writes them, which its scoring takes.

    From the fourth on a run is its difference to the one before the last. A number is written in
    digits of 5 bits, the lowest first, each plus 48; bit 6 says that more follow, and the highest
    digit's bit 5 is the sign.
    """
    text = list[str]()
    for k, count in enumerate(counts):
        left, more = count - (counts[k - 2] if k > 2 else 0), True
        while more:
            digit, left = left & 31, left >> 5
            more = left != (-1 if digit & 16 else 0)
            text.append(chr(48 + digit + 32 * more))
    return "".join(text)
