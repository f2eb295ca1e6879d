"""How long a picture takes: milliseconds a frame by size, camera and renderer, one frame at a time,
and how far the renderers agree.

    python benchmarks/picture.py [--out picture.json] [--frames 50] [--renderers opencv mujoco]

Times are medians over frames of different ropes, after one frame to warm up, with OpenCV held to
one thread. Agreement is measured over the pixels that show rope in either picture.
"""

import argparse
import itertools
import json
import os
import platform
import statistics
import time
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from knotgym.common.errors import KnotgymError
from knotgym.rendering.camera import PictureConfig
from knotgym.rendering.picture import draw, draw_many

SIZES = (64, 128, 256, 512)
CAMERAS: tuple[Literal["orthographic", "perspective"], ...] = ("orthographic", "perspective")


def ropes(count: int, seed: int = 0, beads: int = 100, length: float = 1.33) -> NDArray[np.float64]:
    """Random closed curves of a rope's length, tangled like one: float64, shape (count, beads, 3),
    metres.
    """
    rng = np.random.default_rng(seed)
    phase = 2.0 * np.pi * np.arange(beads) / beads
    order = np.arange(1, 6)[:, None]
    cos, sin = rng.normal(size=(2, count, 3, 5, 1)) / order**1.2
    curves = np.moveaxis(
        (cos * np.cos(order * phase) + sin * np.sin(order * phase)).sum(axis=2), 1, 2
    )
    curves[..., 2] *= 0.3
    total = np.linalg.norm(np.diff(curves, axis=1, append=curves[:, :1]), axis=2).sum(axis=1)
    return np.asarray(curves * (length / total)[:, None, None], dtype=np.float64)


def median_ms(config: PictureConfig, points: NDArray[np.float64]) -> float:
    draw(points[0], config)
    times = []
    for rope in points:
        start = time.perf_counter()
        draw(rope, config)
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def agreement(
    size: int, camera: Literal["orthographic", "perspective"], points: NDArray[np.float64]
) -> dict[str, float]:
    one, other = (
        draw_many(points, PictureConfig(size=size, camera=camera, renderer=renderer))
        for renderer in ("opencv", "mujoco")
    )
    first, second = one.any(axis=-1), other.any(axis=-1)
    rope = first | second
    apart = np.abs(one.astype(np.int16) - other)
    worst = apart.max(axis=-1)[rope]
    return {
        "mean_difference_picture": float(apart.mean()),
        "mean_difference_rope": float(apart[rope].mean()),
        "share_of_rope_over_64": float((worst > 64).mean()),
        "share_of_rope_over_128": float((worst > 128).mean()),
        "silhouette_iou": float((first & second).sum() / rope.sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("picture.json"))
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument(
        "--renderers", nargs="+", choices=("opencv", "mujoco"), default=["opencv", "mujoco"]
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    points = ropes(arguments.frames)
    console = Console()
    rows: list[dict[str, Any]] = []
    table = Table(
        "camera",
        "size",
        *(f"{renderer}, ms" for renderer in arguments.renderers),
        "mean diff",
        ">128 levels",
        "IoU",
    )
    for camera, size in itertools.product(CAMERAS, SIZES):
        row: dict[str, Any] = {"camera": camera, "size": size}
        for renderer in arguments.renderers:
            try:
                row[f"{renderer}_ms"] = median_ms(
                    PictureConfig(size=size, camera=camera, renderer=renderer), points
                )
            except KnotgymError as error:
                row[f"{renderer}_error"] = str(error)
        if "opencv_ms" in row and "mujoco_ms" in row:
            row |= agreement(size, camera, points[:20])
        rows.append(row)
        times = (
            f"{row[f'{renderer}_ms']:.2f}" if f"{renderer}_ms" in row else "none"
            for renderer in arguments.renderers
        )
        agree = (
            (
                f"{row['mean_difference_rope']:.2f}",
                f"{row['share_of_rope_over_128']:.3%}",
                f"{row['silhouette_iou']:.3f}",
            )
            if "silhouette_iou" in row
            else ()
        )
        table.add_row(camera, str(size), *times, *agree)
    console.print(table)
    for message in sorted(
        {value for row in rows for name, value in row.items() if name.endswith("_error")}
    ):
        console.print(message)
    machine = {
        "platform": platform.platform(),
        "processor": platform.processor(),
        "cores": os.cpu_count(),
        "opencv": cv2.__version__,
    }
    arguments.out.write_text(
        json.dumps({"machine": machine, "frames": arguments.frames, "rows": rows}, indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
