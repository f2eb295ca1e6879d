"""The picture: camera, colours, and which strand is on top."""

import dataclasses
import functools
import os
import runpy
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.rendering.camera import PictureConfig, bead_colours, project
from knotgym.rendering.picture import draw
from knotgym.rope import Rope
from knotgym.states import read_states, shipped
from knotgym.topology import find_crossings

from ..scripts import ROOT

Points = NDArray[np.float64]
Image = NDArray[np.uint8]
LOOP = Rope().loop()  # 0.2 m wide, flat


# which strand a picture shows on top; benchmarks/truth.py counts with it
shown_strands: Any = runpy.run_path(str(ROOT / "benchmarks" / "picture_check.py"))["shown_strands"]


# what fresh processes begin with, as OpenGL may crash
PRELUDE = """import os, threading
import numpy as np
from knotgym.common import KnotgymError
from knotgym.rendering import PictureConfig, draw
def show(): return draw(np.eye(3) * 0.1, PictureConfig(size=16, renderer="mujoco"))
"""


def apart(code: str, *before: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process of its own, after PRELUDE."""
    words, env = [*before, sys.executable, "-c", PRELUDE + code], {**os.environ, **env}
    return subprocess.run(words, capture_output=True, text=True, timeout=120, env=env)


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip if MuJoCo's renderer can't draw."""
    if apart("show()").returncode != 0:
        pytest.skip("no OpenGL context can be made here")


def gl(test: Callable[..., None]) -> Any:
    return pytest.mark.gl(pytest.mark.usefixtures("opengl")(test))


@functools.cache
def curves() -> Points:
    """Forty legible ropes, ten of each number of crossings from 1 to 4."""
    states = read_states(shipped(), images=False)
    rows = [np.flatnonzero(states.nx == nx)[:10] for nx in (4, 3, 2, 1)]
    made: Points = states.points[np.stack(rows, axis=1).ravel()]
    made.setflags(write=False)
    return made


def traced(points: Points, config: PictureConfig) -> Image:
    """Draw the orthographic picture by brute force: the highest capsule on each sample's ray."""
    samples = 4
    side = config.size * samples
    place = ((np.arange(side) + 0.5) / side - 0.5) * config.view
    points = points - points.mean(axis=0)
    top = np.full((side, side), -np.inf)
    image = np.zeros((side, side, 3), dtype=np.uint8)
    for a, b, colour in zip(
        points, np.roll(points, -1, axis=0), bead_colours(len(points)), strict=True
    ):
        columns = np.flatnonzero(
            (place > min(a[0], b[0]) - 0.006) & (place < max(a[0], b[0]) + 0.006)
        )
        rows = np.flatnonzero(
            (-place > min(a[1], b[1]) - 0.006) & (-place < max(a[1], b[1]) + 0.006)
        )
        if not (len(columns) and len(rows)):
            continue
        window = np.ix_(rows, columns)
        x, y = np.meshgrid(place[columns] - a[0], -place[rows] - a[1])
        along, rise = (b - a)[:2], b[2] - a[2]
        length = np.linalg.norm(along)
        # The upper surface of a capsule is the highest of the spheres strung on its axis. At a
        # sample beside `at`, the nearest place on the axis (0 at a, 1 at b), the sphere around t is
        # rise t + sqrt(room - (t - at)^2 length^2) high, which has its maximum at `best`.
        at = (x * along[0] + y * along[1]) / length**2
        room = config.rope_radius**2 - ((x * along[1] - y * along[0]) / length) ** 2
        best = at + rise * np.sqrt(np.maximum(room, 0)) / (length * np.hypot(length, rise))
        best = best.clip(0, 1)
        inside = room - ((best - at) * length) ** 2
        surface = a[2] + best * rise + np.sqrt(np.maximum(inside, 0))
        surface[inside < 0] = -np.inf
        higher = surface > top[window]
        top[window] = np.where(higher, surface, top[window])
        image[window] = np.where(higher[..., None], colour, image[window])
    blocks = image.reshape(config.size, samples, config.size, samples, 3)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), dtype=np.uint8)


def differences(one: Image, other: Image) -> tuple[float, float, float, float]:
    """Return the mean absolute difference of the rope's pixels, and the fraction of them that
    differ by more than 64 levels.
    """
    first, second = one.any(axis=-1), other.any(axis=-1)
    rope = first | second
    apart = np.abs(one.astype(int) - other)[rope]
    worst = apart.max(axis=-1)
    return (
        float(apart.mean()),
        float((worst > 64).mean()),
        float((worst > 128).mean()),
        float((first & second).sum() / rope.sum()),
    )


def white(beads: int) -> Image:
    return np.full((beads, 3), 255, dtype=np.uint8)


# Colours


def test_the_base_bead_is_white_and_the_rope_runs_towards_red() -> None:
    colours = bead_colours(100)
    assert colours.dtype == np.uint8 and colours.shape == (100, 3)
    assert colours[0].tolist() == [255, 255, 255]
    assert np.all(np.diff(colours[1:26, 0].astype(int)) >= 0) and colours[25, 0] == 255
    # green is brightest a third of a turn before red, blue two thirds, as published
    assert colours[[92, 58]].tolist() == [[66, 255, 59], [66, 59, 255]]


# Camera


def test_a_bead_is_drawn_where_it_is_projected() -> None:
    points = curves()[0]
    for config in (
        PictureConfig(),
        PictureConfig(camera="perspective"),
        PictureConfig(turn=1.0, zoom=0.8),
        PictureConfig(size=256),
    ):
        off = []
        for bead in range(1, 99):
            colours = np.zeros((100, 3), dtype=np.uint8)
            colours[bead] = 255
            image = draw(points, config, colours=colours).astype(float)[..., 0]
            halfway = points[bead : bead + 2].mean(axis=0)
            middle = project(halfway[None], config, points.mean(axis=0))
            row, column = np.indices(image.shape) + 0.5
            seen = np.array([(column * image).sum(), (row * image).sum()]) / image.sum()
            off.append(seen - middle[0])
        # a pixel of a strand has the colour of one piece, the one at its centre
        assert np.abs(np.median(off, axis=0)).max() < 0.1 and np.median(np.abs(off)) < 0.2


def test_a_straight_rope_is_as_wide_as_it_should_be() -> None:
    points = np.array([[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, -0.02]])
    for size in (64, 128, 256, 512):
        for width in (1.0, 2.0):
            config = PictureConfig(size=size, width=width)
            image, wanted = draw(points, config, colours=white(4)), 2.0 * config.drawn_radius
            across = image[:, size // 2 + size // 16, 0].sum() / 255.0 / config.pixels_per_metre
            assert across == pytest.approx(wanted, rel=0.07, abs=0.03 / config.pixels_per_metre)


def test_the_perspective_camera_is_the_published_one() -> None:
    config = PictureConfig(camera="perspective")
    edge = np.array(
        [[0.8 * np.tan(np.radians(22.5)), 0.0, 0.0], [0.4 * np.tan(np.radians(22.5)), 0.0, 0.4]]
    )
    assert project(edge, config, center=np.zeros(3)) == pytest.approx(
        np.array([[128.0, 64.0], [128.0, 64.0]])
    )


def test_what_is_behind_the_perspective_camera_is_not_drawn() -> None:
    points = LOOP + np.arange(100)[:, None] // 50 * (0, 0, -3.0)
    config = PictureConfig(camera="perspective")
    assert np.isnan(project(points, config)[:50]).all()
    assert draw(points, config).shape == (128, 128, 3)


# Drawing


def test_the_same_points_give_the_same_bytes_wherever_they_are_and_are_left_alone() -> None:
    points = np.round(curves()[4] * 2**20) / 2**20  # so that the shift is exact
    kept = points.copy()
    assert np.array_equal(draw(points), draw(kept)) and np.array_equal(points, kept)
    assert np.abs(draw(points).astype(int) - draw(points + [0.5, -1.0, 0.25])).max() <= 8


def test_draw_many_is_draw_many_times() -> None:
    for config in (
        PictureConfig(),
        PictureConfig(camera="perspective", background=(20, 30, 40), size=96),
    ):
        together = draw(curves()[:5], config)
        assert together.dtype == np.uint8
        assert np.array_equal(together, np.stack([draw(points, config) for points in curves()[:5]]))
    assert draw(np.empty((0, 100, 3))).shape == (0, 128, 128, 3)


def test_outside_the_rope_is_the_background_and_outside_the_picture_nothing() -> None:
    image = draw(2 * LOOP, PictureConfig(background=(10, 20, 30)))
    for pixels in (image[64], image[:, 64]):
        assert (pixels == (10, 20, 30)).all()
    assert (image != (10, 20, 30)).any() and not draw(1e9 * LOOP).any()


TWELFTHS = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
SHAPES = {
    "ropes": curves()[:12],
    # a star, whose joints turn by 150 degrees
    "star": np.array(
        [0.2 * np.cos(5 * TWELFTHS), 0.2 * np.sin(5 * TWELFTHS), 0.02 * np.sin(TWELFTHS)]
    ).T[None],
    "seen end on": np.array(
        [
            [(0.1 + 1e-6 * k, 0.1, 0.0133 * k) for k in range(11)]
            + [(0.11, -0.1, 0.133), (0.09, -0.1, 0.0)]
        ]
    ),
    # a long steep bead goes over one strand and under another
    "steep": np.array(
        [[-0.1, 0.1, -0.08, -0.08, 0.08, 0.08], [0, 0, 0.1, -0.1, -0.1, 0.1]]
        + [[0, 0.1, 0.02, 0.02, 0.08, 0.08]]
    ).T[None],
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_picture_is_that_of_a_ray_tracer(name: str) -> None:
    config = PictureConfig(size=512 if name in ("seen end on", "steep") else 128)
    drawn = draw(SHAPES[name], config)
    exact = np.stack([traced(points, config) for points in SHAPES[name]])
    mean, far, wrong, overlap = differences(drawn, exact)
    assert mean < 3.5 and far < 0.01 and wrong < 0.001 and overlap > 0.97


# Over and under


def shown(drawn: Points, config: PictureConfig) -> NDArray[np.str_]:
    """Which strands pictures of `drawn` show, at the crossings of `curves`."""
    return np.concatenate(
        [
            shown_strands(draw(one, config), find_crossings(points), points, config)
            for one, points in zip(drawn, curves(), strict=False)
        ]
    )


def test_at_every_crossing_the_over_strand_is_shown() -> None:
    found = shown(curves(), PictureConfig())
    assert len(found) > 40
    assert not np.any(found == "under") and np.mean(found == "over") > 0.85
    upside_down = shown(curves()[:10] * [1.0, 1.0, -1.0], PictureConfig())
    assert not np.any(upside_down == "over") and np.sum(upside_down == "under") > 10


# Settings and errors


def test_no_opengl_is_one_clear_line() -> None:
    done = apart("try: show()\nexcept KnotgymError as error: print(error)", MUJOCO_GL="off")
    assert len(done.stdout.splitlines()) == 1 and not done.stderr
    assert "renderer='opencv'" in done.stdout


# MuJoCo's renderer


@gl
@pytest.mark.parametrize(
    ("config", "mean_limit"),
    [
        (PictureConfig(size=64), 6.0),
        (PictureConfig(camera="perspective"), 4.0),
        (PictureConfig(size=256), 3.0),
        (PictureConfig(views=("top", "left", "front")), 4.0),
    ],
)
def test_both_renderers_draw_the_same_picture(config: PictureConfig, mean_limit: float) -> None:
    opencv = draw(curves(), config)
    mujoco = draw(curves(), dataclasses.replace(config, renderer="mujoco"))
    mean, far, wrong, overlap = differences(opencv, mujoco)
    assert mean < mean_limit and far < 0.01 and wrong < 0.002 and overlap > 0.95


@gl
def test_both_renderers_obey_every_setting() -> None:
    config = PictureConfig(turn=0.7, zoom=1.5, width=1.4, background=(40, 80, 120))
    for one in (config, dataclasses.replace(config, camera="perspective")):
        other = dataclasses.replace(one, renderer="mujoco")
        apart = np.abs(draw(curves()[6], one).astype(int) - draw(curves()[6], other))
        assert apart.mean() < 1.5 and (apart.max(axis=-1) > 64).mean() < 0.005
        assert apart[0, 0].max() == 0


@gl
def test_mujoco_shows_the_over_strand_too() -> None:
    assert not np.any(shown(curves()[:15], PictureConfig(renderer="mujoco")) == "under")


@gl
def test_mujoco_draws_in_threads_and_again_after_closing() -> None:
    from knotgym.rendering import mujoco_renderer as picture_mujoco

    config = PictureConfig(size=64, renderer="mujoco")
    first = draw(LOOP, config)
    drawn: list[Image] = []

    def work() -> None:
        drawn.append(draw(LOOP, config))
        picture_mujoco._close()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    picture_mujoco._close()
    picture_mujoco._close()
    drawn.append(draw(LOOP, config))
    assert len(drawn) == 2 and all(np.array_equal(first, image) for image in drawn)


@gl
def test_mujoco_leaves_the_process_without_a_word() -> None:
    done = apart(
        "thread = threading.Thread(target=show); thread.start(); thread.join(); show()\n"
        "print(os.environ.get('MUJOCO_GL'))"
    )
    assert done.stdout.strip() == str(os.environ.get("MUJOCO_GL")) and not done.stderr


@gl
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_mujoco_refuses_to_draw_in_the_fork_of_a_process_that_drew() -> None:
    done = apart(
        "show(); child = os.fork()\ntry: show()\nexcept KnotgymError: os._exit(3)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    assert done.stdout.strip() == "3"
