"""Train a learner, that is its reader; resumable and reproducible to the bit."""

import csv
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

import knotgym
from knotgym.common.atomic_files import atomic_write, move_into_place, remove, require_output
from knotgym.common.configuration import as_json, differences, read_json
from knotgym.common.errors import InvalidInput, one_line
from knotgym.common.hdf5_files import require_regular
from knotgym.common.streams import Stream, generator
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.learn.checkpoint import CARD, Learned, load_policy, read_card, save_policy
from knotgym.learn.reader_training import ReaderTraining
from knotgym.learn.train_config import TrainConfig
from knotgym.learn.training_data import TrainingData, read_training_data
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import REFUSE_EXISTING, Existing
from knotgym.runs.staging import (
    discard,
    has_work,
    may_be_finished,
    require_no_interrupted_run,
    staging,
    staging_folder,
)

UNDER_WAY, REQUEST = "training.safetensors", "training.json"
_SEAL = "seal"  # name of the array that holds the digest of the others
_SECONDS = "seconds"  # and of the one that says how long the training has taken
_CURVE_WINDOW = 50  # steps averaged in each row of the learning curve


def train(
    datasets: Sequence[Any],
    out: Path,
    config: TrainConfig,
    *,
    existing: Existing = REFUSE_EXISTING,
    quiet: bool = False,
    progress: Progress | None = None,
) -> Learned:
    """Train a learner on datasets and write its checkpoint folder.

    Args:
        datasets: ids or folders.
        quiet: show no progress; ignored if `progress` is given.

    Raises:
        InvalidInput: the datasets are unsuitable, or the training to resume has other settings
            or is corrupted.
        Occupied: `out` exists, holds an interrupted training, or is used by another process.
        Failed: `out` can't be written.
        InvalidFile, MissingFile: a dataset is missing or invalid.
    """
    if progress is None:
        with Progress(quiet) as progress:
            return train(datasets, out, config, existing=existing, progress=progress)
    shown, made = progress, list[Learned]()

    def read() -> tuple[TrainingData, str]:
        data = read_training_data(datasets, config.engine)
        return data, data.digest

    def make(data: TrainingData, request: dict[str, Any], folder: Path) -> None:
        made.append(_trained(datasets, data, config, request, folder, shown))

    run_training(datasets, out, config, existing, progress, read, make)
    return made[0] if made else load_policy(str(out))


Data = TypeVar("Data")


def run_training(
    datasets: Sequence[Any],
    out: Path,
    config: Any,
    existing: Existing,
    progress: Progress,
    read: Callable[[], tuple[Data, str]],
    make: Callable[[Data, dict[str, Any], Path], None],
) -> None:
    """Run a training in a staging folder, unless it is finished already; see `train` for errors.

    Args:
        datasets, out, existing, progress: as of `train`.
        config: a dataclass of settings.
        read: reads the datasets; returns what `make` takes, and its digest.
        make: trains in a folder, resuming what it holds; writes the checkpoint to `made` in it.
            Also takes the settings and the digest.
    """
    finished = may_be_finished(out, existing) and (out / CARD).is_file()
    if not finished:
        require_output(out, folder=True, overwrite=existing.overwrite)
    require_no_interrupted_run(out, existing)
    for dataset in datasets:
        EpisodeReader(dataset).close()
    progress.stage("reading the episodes")
    data, digest = read()
    request = {"config": as_json(config), "data_sha256": digest}
    if finished:
        card = read_card(out)
        differing = list(differences({name: card.get(name) for name in request}, request))
        if not differing:
            discard(out)
            progress.say(f"{out} is finished already")
            return
        if not existing.overwrite:
            raise InvalidInput(
                f"{out} holds a training with other settings: {'; '.join(differing[:3])}; choose"
                " another --out, or replace it by --overwrite"
            )
    with staging(out, existing) as folder:
        make(data, request, folder)
        move_into_place(folder / "made", out, overwrite=existing.overwrite)
    shutil.rmtree(staging_folder(out))


def _trained(
    datasets: Sequence[Any],
    data: TrainingData,
    config: TrainConfig,
    request: dict[str, Any],
    folder: Path,
    progress: Progress,
) -> Learned:
    """Train in a staging folder, resuming what it holds; write the checkpoint to `made` in it."""
    kept, began = begin_training(folder, request)
    training = ReaderTraining(data, config.steps, config.batch, config.seed)
    if kept:
        _restore(folder, training, kept)

    def status() -> Status:
        facts = {"loss": f"{training.losses[-1][1]:.3f}"} if training.losses else {}
        return Status(training.step, config.steps, "steps of the reader", facts, even=True)

    progress.stage("training the reader")
    while training.step < config.steps:
        progress.show(status)
        training.advance()
        if training.step % config.save_every == 0 or training.step == config.steps:
            keep_training(folder, training.state(), began)
    progress.show(status, last=True)
    learned = Learned(training.reader.eval(), _starts(data, config))
    made_in = folder / "made"
    remove(made_in)
    made_in.mkdir()
    curve = [
        (start + _CURVE_WINDOW, *np.mean(training.losses[start : start + _CURVE_WINDOW], axis=0))
        for start in range(0, len(training.losses), _CURVE_WINDOW)
    ]
    draw_curve(made_in, ("join", "correct"), curve)
    made = {
        "knotgym": knotgym.__version__,
        **request,
        "data": ["/".join(Path(str(one)).parts[-3:]) for one in datasets],
        "episodes": len(data.starts),
        "frames": len(data.frames),
        "seconds": round(time.perf_counter() - began),
    }
    save_policy(made_in, learned, made)
    return learned


def begin_training(folder: Path, request: dict[str, Any]) -> tuple[dict[str, Tensor], float]:
    """Begin a training in a staging folder, or load the checkpoint of the one to resume.

    Returns:
        What `keep_training` kept; and when the training began, in seconds of `time.perf_counter`,
        as if it hadn't been interrupted.

    Raises:
        InvalidInput: that training has other settings or is corrupted.
    """
    now = time.perf_counter()
    if not has_work(folder):
        with atomic_write(folder / REQUEST) as part:
            part.write_text(json.dumps(request, indent=1) + "\n", encoding="utf-8")
        return {}, now
    try:
        before = read_json(folder / REQUEST)
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"no training to resume in {folder}, its {REQUEST} is missing or damaged; --restart"
            " starts over"
        ) from error
    if not isinstance(before, dict):
        raise InvalidInput(f"{folder / REQUEST} doesn't hold a training's settings")
    found = list(differences(before, request))
    if found:
        raise InvalidInput(
            f"the training to resume has other settings: {'; '.join(found)}; give the same ones,"
            " or --restart to discard it"
        )
    if not (folder / UNDER_WAY).exists():
        return {}, now
    require_regular(folder / UNDER_WAY, "training", InvalidInput)
    try:
        kept: dict[str, Tensor] = load((folder / UNDER_WAY).read_bytes())
        seal = bytes(kept.pop(_SEAL, torch.zeros(0)).to(torch.uint8).tolist())
        if seal != _digest(kept):
            raise InvalidInput(f"{folder / UNDER_WAY} is corrupted: its checksum differs")
    except (SafetensorError, RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, InvalidInput):
            raise
        raise InvalidInput(f"{folder / UNDER_WAY} can't be read: {one_line(error)}") from error
    return kept, now - kept.pop(_SECONDS, torch.zeros(1)).item()


def _restore(folder: Path, training: ReaderTraining, kept: dict[str, Tensor]) -> None:
    try:
        training.restore(kept)
    except (KeyError, ValueError, RuntimeError) as error:
        raise InvalidInput(f"{folder / UNDER_WAY} can't be read: {error}") from error


def keep_training(folder: Path, kept: dict[str, Tensor], began: float) -> None:
    """Write the state of a training, sealed by its digest, into its staging folder."""
    kept = {name: own.contiguous() for name, own in kept.items()}
    kept[_SECONDS] = torch.tensor([time.perf_counter() - began])
    seal = torch.tensor(list(_digest(kept)), dtype=torch.uint8)
    with atomic_write(folder / UNDER_WAY) as part:
        part.write_bytes(save({**kept, _SEAL: seal}))


def _digest(kept: dict[str, Tensor]) -> bytes:
    """Return the SHA-256 of all tensors with their names, dtypes and shapes."""
    whole = hashlib.sha256()
    for name, own in sorted(kept.items()):
        whole.update(json.dumps([name, str(own.dtype), [*own.shape]]).encode())
        whole.update(own.detach().numpy().tobytes())
    return whole.digest()


def _starts(data: TrainingData, config: TrainConfig) -> NDArray[np.float32]:
    """Draw start positions of ropes' middles, float32 (n, 3), metres."""
    rng = generator(Stream.LEARN_PLACES, config.seed)
    rows = data.starts[np.sort(rng.permutation(len(data.starts))[: config.places])]
    middles: NDArray[np.float32] = data.frames[rows].mean(axis=1).astype(np.float32)
    return middles


def draw_curve(
    out: Path, names: tuple[str, str], curve: Sequence[tuple[int, float, float]]
) -> None:
    """Write `curve.csv` and `curve.png`: two losses, the first blue and the second orange.

    Args:
        names: of the losses.
        curve: step and both losses, at least one row.
    """
    rows = [(step, round(first, 5), round(second, 5)) for step, first, second in curve]
    with atomic_write(out / "curve.csv") as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("step", *names))
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
