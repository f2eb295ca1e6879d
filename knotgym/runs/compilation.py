"""Compilation before a run, so that its processes don't all wait for the same kernels."""

import gc
from collections.abc import Callable
from concurrent.futures import Executor

from knotgym.rope import CHAIN, MUJOCO, is_compiled, simulation
from knotgym.runs.executors import InProcess
from knotgym.runs.progress import Progress

_PICTURES, _DRAWINGS, _MEASURES = "pictures", "drawings", "measures"


def compile_first(
    progress: Progress,
    engine: str = MUJOCO,
    pool: Executor | None = None,
    *,
    draws: bool = False,
    plan: Callable[[], None] | None = None,
) -> None:
    """Compile an engine's kernels, if they aren't; beside them, those that paint pictures.

    Both take about as long, so two processes of the pool compile them. In this process alone,
    which is the default, pictures wait until one is painted. A run that draws states also needs
    the kernels that draw and measure them, and one that plans in the chain engine those that
    `plan`, a function of a module, uses; otherwise each of its workers would compile them. States
    are drawn before anything is planned, so `plan` may still be under way on return.
    """
    engines = [CHAIN, engine] if plan is not None and engine != CHAIN else [engine]
    if not all(map(is_compiled, engines)):
        progress.stage("compiling, only on the first run")
        pool = pool or InProcess()
        # longest first; what several need is in the cache when the second comes to it
        longest, *others = engines
        if not isinstance(pool, InProcess):
            parts = [_DRAWINGS, _PICTURES, _MEASURES] if draws else [_PICTURES]
            others = [*parts, *others]
        first = pool.submit(_compile, longest)
        later = [pool.submit(_compile, name) for name in others]
        first.result()
        if plan is not None:
            planned = pool.submit(plan)  # moves ropes in the engine that is compiled by now
            later += [] if draws else [planned]
        for compiled in later:
            compiled.result()
    progress.stage("starting")


def _compile(kernels: str) -> None:
    import numpy as np

    from knotgym.rope import Rope

    gc.disable()  # it finds nothing meanwhile, and takes a twentieth of the time
    rope, rng = Rope(), np.random.default_rng(0)
    if kernels == _PICTURES:
        from knotgym.rendering import draw

        draw(rope.loop())
    elif kernels == _DRAWINGS:
        from knotgym.drawing import drawn_curve
        from knotgym.topology import GaussCode

        drawn_curve(GaussCode.parse("1+,1-"), rng, rope)
    elif kernels == _MEASURES:
        from knotgym.quality import measure, noise_survival
        from knotgym.topology import pyknotid_code

        t = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        eight = np.stack([0.3 * np.sin(t), 0.15 * np.sin(2 * t), 0.01 * np.cos(t)], axis=1)
        points = rope.from_curve(eight)
        measure(points)
        noise_survival(points, 0.015, rng, draws=2)
        pyknotid_code(points)
        rope.qpos(points)
    else:
        from knotgym.topology import label

        first = simulation(kernels)
        first.step([0], [[0.0, 0.0, 0.0]])
        label(first.points[0])
    gc.enable()
