"""The command `knotgym train`."""

from collections.abc import Callable
from functools import cache, partial
from math import isnan
from pathlib import Path

from knotgym.cli import EXISTING, Given, command
from knotgym.common import InvalidInput, MissingExtra
from knotgym.learn.learners import LEARNERS, PICTURES

_SECTIONS = {row.section: row.config for row in LEARNERS.values()}


@command(_SECTIONS, f"steps seed run.workers {EXISTING}")
def train(
    given: Given,
    *,
    out: Path,
    data: list[str] | None = None,
    learner: str = PICTURES,
    log: str | None = None,
) -> None:
    """Train a policy; evaluate it with `knotgym evaluate --policy FOLDER`.

    Examples:

        knotgym train --data knotgym/tie-nx2/expert-v0 --out runs/reader

        knotgym train --learner clone --set clone.demonstrations=2000 --out clone

    Args:
        out: Folder to write: weights, policy.json (data, settings and results of the training) and
            learning curves.
        data: Minari id or folder of train-split episodes; may be repeated.
        learner: pictures: the learner from pictures alone. clone: imitates the macro-actions of a
            planner, from vertices; its settings are in the section clone.
        log: Also write the learning curve, as it grows, beside the folder: tensorboard, or wandb
            (offline). Needs the extra log.
    """
    if learner not in LEARNERS:
        known = ", ".join(LEARNERS)
        raise InvalidInput(
            f"no learner {learner!r}; there is {known}; examples/learners trains others"
        )
    section = LEARNERS[learner].section
    for name, other in LEARNERS.items():
        if other.section not in ("", section) and given.has(other.section):
            raise InvalidInput(f"settings of the {name} are for --learner {name}")
    common = {name: given.get(name) for name in ("steps", "seed") if given.has(name)}
    config = given.config(LEARNERS[learner].config, common, section=section)
    for library in ("torch", "safetensors"):
        MissingExtra.imported(library, "learn", "knotgym train")
    from knotgym.learn.train_recipe import train as train_learner

    writer = _log_writer(log, out) if log else None
    train_learner(data or [], out, config, given.run, given.progress, writer)
    given.progress.say(f"next: knotgym evaluate --policy {out} --split train,test")


def _log_writer(name: str, out: Path) -> Callable[[int, dict[str, float]], None]:
    """Return what writes values by name at a step; a library's own writer opens at the first.

    Raises:
        InvalidInput: there is no writer of that name.
        MissingExtra: the library isn't installed.
    """
    if name not in LOGS:
        raise InvalidInput(f"no log {name!r}; there is {', '.join(LOGS)}")
    MissingExtra.imported(name, "log", f"--log {name}")
    opened = cache(partial(LOGS[name], out))

    def _write(step: int, values: dict[str, float]) -> None:
        opened()(step, {name: value for name, value in values.items() if not isnan(value)})

    return _write


def _tensorboard(out: Path) -> Callable[[int, dict[str, float]], None]:
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(f"{out}.tensorboard")

    def _write(step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, step)
        writer.flush()

    return _write


def _wandb(out: Path) -> Callable[[int, dict[str, float]], None]:
    import wandb

    folder = Path(f"{out}.wandb")
    folder.mkdir(parents=True, exist_ok=True)
    run = wandb.init(project="knotgym", name=out.name, dir=folder, mode="offline")
    return lambda step, values: run.log(values, step=step)


LOGS = {"tensorboard": _tensorboard, "wandb": _wandb}  # by the library's name
