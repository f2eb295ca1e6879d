"""Compilation before a run, so that its processes don't all wait for the same kernels."""

from knotgym.rope.engines import MUJOCO, compile_engine, is_compiled
from knotgym.runs.executors import cores, executor
from knotgym.runs.progress import Progress

_PICTURES = "pictures"


def compile_first(progress: Progress, engine: str = MUJOCO, workers: int = 1) -> None:
    """Compile an engine's kernels, if they aren't; beside them, those that draw pictures.

    Both take about as long, so two processes compile them; with one worker (0: one per core),
    pictures wait until one is drawn.
    """
    if not is_compiled(engine):
        progress.stage("compiling, only on the first run")
        count = min(2, workers or cores())
        with executor(count) as pool:
            list(pool.map(_compile, (engine, _PICTURES)[:count]))
    progress.stage("starting")


def _compile(kernels: str) -> None:
    if kernels == _PICTURES:
        from knotgym.rendering.picture import draw
        from knotgym.rope.model import Rope

        draw(Rope().loop())
    else:
        compile_engine(kernels)
