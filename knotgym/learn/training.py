"""Training a learner: the rope's model, then the reader; resumable, the same bytes every time."""

from __future__ import annotations

import csv
import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

import knotgym
from knotgym.atomic_files import atomic_write, require_writable
from knotgym.configuration import as_json, check_numbers, differences, read_json
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.errors import KnotgymError, one_line
from knotgym.hdf5_files import require_regular
from knotgym.learn.checkpoint import Learned, save_policy
from knotgym.learn.fitting import STAGES, Stretches, fitted
from knotgym.learn.reader_training import ReaderTraining
from knotgym.learn.rope_model import FIRST_GUESS, Dynamics
from knotgym.learn.training_data import TrainingData, read_training_data
from knotgym.runs.progress import Progress, Status
from knotgym.streams import Stream, generator

UNDER_WAY, REQUEST = "training.safetensors", "training.json"
_SEAL = "seal"  # among the arrays kept: the digest of the others
_AT_ONCE = 50  # steps that a row of the curve is the mean of


class InvalidTraining(KnotgymError, ValueError):
    """A training that can't be done as asked."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a learner is trained.

    Attributes:
        steps: of the reader.
        batch: pictures of a step.
        stretches: beginnings of episodes that the rope's model is fitted to, at most.
        tries: of its numbers, twice.
        places: starts of episodes that are kept, at most.
        save_every: steps between two checkpoints.
        seed: of everything.
    """

    steps: int = 3000
    batch: int = 48
    stretches: int = 100
    tries: int = 150
    places: int = 512
    save_every: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("steps", "batch", "stretches", "tries", "places", "save_every"),
            whole=("seed",),
            error=InvalidTraining,
        )


def train(
    datasets: Sequence[Any],
    out: Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    quiet: bool = False,
    progress: Progress | None = None,
) -> Learned:
    """Train a learner on datasets and write its folder.

    Raises:
        InvalidTraining: the folder holds another training, or none to resume.
        Unwritable: nothing can be written there.
        InvalidTrainingData, InvalidEpisodeFile, MissingFile: the data won't do.
    """
    if progress is None:
        with Progress(quiet) as progress:
            return train(datasets, out, config, resume=resume, progress=progress)
    began = time.perf_counter()
    require_writable(out)
    for dataset in datasets:
        EpisodeReader(dataset).close()
    progress.stage("reading the episodes")
    data = read_training_data(datasets)
    request = {"config": as_json(config), "data_sha256": data.digest}
    kept = _begin(out, request, resume)
    if "rope" not in kept:
        kept |= _fit_rope(data, config, progress)
        _keep(out, kept)
    rope = kept["rope"].numpy()
    training = ReaderTraining(data, Dynamics(rope), config.steps, config.batch, config.seed)
    if "losses" in kept:
        _restore(out, training, kept)

    def status() -> Status:
        facts = {"loss": f"{training.losses[-1][1]:.3f}"} if training.losses else {}
        return Status(training.step, config.steps, "steps of the reader", facts, even=True)

    progress.stage("learning to read")
    while training.step < config.steps:
        progress.show(status)
        training.advance()
        if training.step % config.save_every == 0 or training.step == config.steps:
            _keep(out, kept | training.state())
    progress.show(status, last=True)
    learned = Learned(training.reader.eval(), rope, _places(data, config))
    _draw_curve(out, training.losses)
    errors = 1000 * kept["fit"]
    made = {
        "knotgym": knotgym.__version__,
        **request,
        "data": ["/".join(Path(str(one)).parts[-3:]) for one in datasets],
        "episodes": len(data.starts),
        "frames": len(data.frames),
        "fit_error_mm": dict(zip(STAGES, errors.round(decimals=3).tolist(), strict=True)),
        "seconds": round(time.perf_counter() - began),
    }
    save_policy(out, learned, made)
    for name in (UNDER_WAY, REQUEST):
        (out / name).unlink()
    return learned


def _begin(out: Path, request: dict[str, Any], resume: bool) -> dict[str, Tensor]:
    """Make the folder; or say what the training in it has kept, to go on with."""
    if not resume:
        if out.is_file() or (out.is_dir() and any(out.iterdir())):
            raise InvalidTraining(
                f"{out} holds something already; name a new folder, or --resume a training in it"
            )
        out.mkdir(parents=True, exist_ok=True)
        with atomic_write(out / REQUEST) as part:
            part.write_text(json.dumps(request, indent=1) + "\n", encoding="utf-8")
        return {}
    try:
        before = read_json(out / REQUEST)
    except (OSError, ValueError) as error:
        raise InvalidTraining(
            f"no training under way in {out}; leave --resume out to begin one"
        ) from error
    if not isinstance(before, dict):
        raise InvalidTraining(f"{out / REQUEST} isn't what a training was asked for")
    if before != request:
        raise InvalidTraining(
            f"the training in {out} differs from the one asked for:"
            f" {'; '.join(differences(before, request))}; give the same again, or choose another"
            " --out"
        )
    if not (out / UNDER_WAY).exists():
        return {}
    require_regular(out / UNDER_WAY, "training", InvalidTraining)
    try:
        kept: dict[str, Tensor] = load((out / UNDER_WAY).read_bytes())
        seal = bytes(kept.pop(_SEAL, torch.zeros(0)).to(torch.uint8).tolist())
        if seal != _digest(kept):
            raise InvalidTraining(f"{out / UNDER_WAY} isn't what was kept: its checksum differs")
    except (SafetensorError, RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, InvalidTraining):
            raise
        raise InvalidTraining(f"{out / UNDER_WAY} can't be read: {one_line(error)}") from error
    if kept.get("rope", torch.zeros(0)).shape != FIRST_GUESS.shape or "fit" not in kept:
        raise InvalidTraining(f"{out / UNDER_WAY} can't be read: it holds no rope's model")
    return kept


def _restore(out: Path, training: ReaderTraining, kept: dict[str, Tensor]) -> None:
    try:
        training.restore(kept)
    except (KeyError, ValueError, RuntimeError) as error:
        raise InvalidTraining(f"{out / UNDER_WAY} can't be read: {error}") from error


def _keep(out: Path, kept: dict[str, Tensor]) -> None:
    kept = {name: own.contiguous() for name, own in kept.items()}
    seal = torch.tensor(list(_digest(kept)), dtype=torch.uint8)
    with atomic_write(out / UNDER_WAY) as part:
        part.write_bytes(save({**kept, _SEAL: seal}))


def _digest(kept: dict[str, Tensor]) -> bytes:
    """SHA-256 of all arrays with their names, types and shapes."""
    whole = hashlib.sha256()
    for name, own in sorted(kept.items()):
        whole.update(json.dumps([name, str(own.dtype), [*own.shape]]).encode())
        whole.update(own.detach().numpy().tobytes())
    return whole.digest()


def _fit_rope(data: TrainingData, config: TrainConfig, progress: Progress) -> dict[str, Tensor]:
    """The numbers of the rope's model, "rope", and the errors that its stages left, "fit"."""
    progress.stage("fitting the rope's model")
    rng = generator(Stream.LEARN_ROPE, config.seed)
    errors: list[float] = []

    def told(stage: str, error: float) -> None:
        errors.append(error)
        progress.say(f"rope's model, {stage}: {1000 * error:.2f} mm")

    rope = fitted(_some(data.stretches, config.stretches, rng), rng, config.tries, told)
    return {"rope": torch.from_numpy(rope), "fit": torch.tensor(errors, dtype=torch.float64)}


def _some(stretches: Stretches, most: int, rng: np.random.Generator) -> Stretches:
    """`most` of the stretches."""
    count = stretches.points.shape[1]
    rows = np.sort(rng.permutation(count)[:most])
    return Stretches(stretches.points[:, rows], stretches.beads[:, rows], stretches.forces[:, rows])


def _places(data: TrainingData, config: TrainConfig) -> NDArray[np.float32]:
    """Where ropes began, float32 (n, 3)."""
    rng = generator(Stream.LEARN_PLACES, config.seed)
    rows = data.starts[np.sort(rng.permutation(len(data.starts))[: config.places])]
    middles: NDArray[np.float32] = data.frames[rows].mean(axis=1).astype(np.float32)
    return middles


def _draw_curve(out: Path, losses: Sequence[tuple[float, float]]) -> None:
    """`curve.csv` and `curve.png`: the losses of the reader's two networks, blue and orange."""
    rows = [
        (start + _AT_ONCE, *np.mean(losses[start : start + _AT_ONCE], axis=0).round(5).tolist())
        for start in range(0, len(losses), _AT_ONCE)
    ]
    with atomic_write(out / "curve.csv") as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("step", "join", "correct"))
        writer.writerows(rows)
    width, height, edge = 640, 360, 40
    image = np.full((height, width, 3), 255, dtype=np.uint8)
    top = max(max(row[1:]) for row in rows)
    for column, colour in ((1, (31, 119, 180)), (2, (255, 127, 14))):
        x = edge + np.array([row[0] for row in rows]) / rows[-1][0] * (width - 2 * edge)
        y = height - edge - np.array([row[column] for row in rows]) / top * (height - 2 * edge)
        line = np.rint(np.stack([x, y], axis=1)).astype(np.int32)
        cv2.polylines(image, [line], False, colour, 2, cv2.LINE_AA)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, f"loss, 0 to {top:.2f}", (edge, 24), font, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(image, f"{rows[-1][0]} steps", (width - 140, height - 12), font, 0.5, (0, 0, 0), 1)
    with atomic_write(out / "curve.png") as part:
        _, encoded = cv2.imencode(".png", image[..., ::-1])
        part.write_bytes(encoded.tobytes())
