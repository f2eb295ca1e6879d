"""Compilation before a run, so that its processes don't all wait for the same kernels."""

from knotgym.rope.engines import MUJOCO, compile_engine, is_compiled
from knotgym.runs.executors import cores, executor
from knotgym.runs.progress import Progress

_PICTURES = "pictures"


def compile_first(progress: Progress, engine: str = MUJOCO) -> None:
    """Compile an engine's kernels, and beside them those that draw pictures, if they aren't yet.

    Both take about as long, so they are compiled by two processes where there are two cores.
    """
    if not is_compiled(engine):
        progress.stage("compiling, only on the first run")
        with executor(min(2, cores())) as pool:
            list(pool.map(_compile, (engine, _PICTURES)))
    progress.stage("starting")


def _compile(kernels: str) -> None:
    if kernels == _PICTURES:
        from knotgym.rendering.picture import draw
        from knotgym.rope.model import Rope

        draw(Rope().loop())
    else:
        compile_engine(kernels)
