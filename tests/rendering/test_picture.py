"""The picture: camera, colours, and which strand is on top."""

import dataclasses
import functools
import os
import runpy
import shutil
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
from knotgym.states import read_states, shipped
from knotgym.topology import find_crossings

from ..scripts import ROOT

Points = NDArray[np.float64]


# which strand a picture shows on top; benchmarks/truth.py counts with it
shown_strands: Any = runpy.run_path(str(ROOT / "benchmarks" / "picture_check.py"))["shown_strands"]


def apart(code: str, *before: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process of its own, as OpenGL may crash."""
    words, env = [*before, sys.executable, "-c", code], {**os.environ, **env}
    return subprocess.run(words, capture_output=True, text=True, timeout=120, env=env)


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip if MuJoCo's renderer can't draw; tried in another process, which may crash."""
    code = (
        "import numpy as np; from knotgym.rendering.picture import PictureConfig, draw;"
        " draw(np.eye(3) * 0.1, PictureConfig(size=16, renderer='mujoco'))"
    )
    if apart(code).returncode != 0:
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


def traced(points: Points, config: PictureConfig) -> NDArray[np.uint8]:
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
        x, y = np.meshgrid(place[columns], -place[rows])
        # The upper surface of a capsule is the highest of the spheres strung on its axis; 41 of
        # them are exact to 0.003 mm.
        centre = a + np.linspace(0.0, 1.0, 41)[:, None] * (b - a)
        inside = (
            config.rope_radius**2
            - (x[..., None] - centre[:, 0]) ** 2
            - (y[..., None] - centre[:, 1]) ** 2
        )
        surface = np.where(
            inside >= 0.0, centre[:, 2] + np.sqrt(np.maximum(inside, 0.0)), -np.inf
        ).max(axis=-1)
        higher = surface > top[window]
        top[window] = np.where(higher, surface, top[window])
        image[window] = np.where(higher[..., None], colour, image[window])
    blocks = image.reshape(config.size, samples, config.size, samples, 3)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), dtype=np.uint8)


def differences(
    one: NDArray[np.uint8], other: NDArray[np.uint8]
) -> tuple[float, float, float, float]:
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


def white(beads: int) -> NDArray[np.uint8]:
    return np.full((beads, 3), 255, dtype=np.uint8)


def ring(beads: int = 100, radius: float = 0.2) -> Points:
    angle = 2.0 * np.pi * np.arange(beads) / beads
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(beads)], axis=1)


# Colours


def test_the_base_bead_is_white_and_the_rope_runs_towards_red() -> None:
    colours = bead_colours(100)
    assert colours.dtype == np.uint8 and colours.shape == (100, 3)
    assert colours[0].tolist() == [255, 255, 255]
    assert np.all(np.diff(colours[1:26, 0].astype(int)) >= 0) and colours[25, 0] == 255


# Camera


def test_image_right_is_world_x_and_image_up_is_world_y() -> None:
    moved = project(
        np.array([[0.0, 0.0, 0.0], [0.066, 0.0, 0.0], [0.0, 0.066, 0.0]]), center=np.zeros(3)
    )
    assert moved == pytest.approx(np.array([[64.0, 64.0], [76.8, 64.0], [64.0, 51.2]]))


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
    points = ring()
    points[:50, 2] += 3.0
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


def test_the_background_is_what_was_asked_for() -> None:
    image = draw(ring(), PictureConfig(background=(10, 20, 30)))
    assert image[0, 0].tolist() == [10, 20, 30] and image[64, 64].tolist() == [10, 20, 30]


def test_what_lies_outside_the_picture_is_cut_off() -> None:
    image = draw(ring(radius=0.4))
    assert not image[64].any() and not image[:, 64].any()
    assert image.any()
    assert not draw(ring(radius=1e9)).any()


def test_neighbouring_beads_leave_no_gap() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    for turns in (1, 5):  # 5: a star, whose joints turn by 150 degrees
        points = np.stack(
            [0.2 * np.cos(turns * angle), 0.2 * np.sin(turns * angle), 0.02 * np.sin(angle)], axis=1
        )
        config = PictureConfig(size=512)
        image = draw(points, config, colours=white(12))
        for fraction in np.linspace(0.0, 1.0, 21):
            at = points + fraction * (np.roll(points, -1, axis=0) - points)
            column, row = np.floor(project(at, config, points.mean(axis=0))).astype(int).T
            assert np.all(image[row, column] == 255)


def test_the_picture_is_that_of_a_ray_tracer() -> None:
    config = PictureConfig()
    drawn = draw(curves()[:12], config)
    exact = np.stack([traced(points, config) for points in curves()[:12]])
    mean, far, wrong, overlap = differences(drawn, exact)
    assert mean < 3.5 and far < 0.01 and wrong < 0.001 and overlap > 0.97


def test_beads_seen_end_on_are_discs() -> None:
    column = np.array([[0.1, 0.1, 0.0133 * bead] for bead in range(11)])
    config = PictureConfig()
    points = np.concatenate([column, [[0.11, -0.1, 0.133], [0.09, -0.1, 0.0]]])
    middle = project(points, config)[0]
    row, column_at = np.indices((128, 128)) + 0.5
    outside = (row < middle[1]) & (np.hypot(column_at - middle[0], row - middle[1]) < 3.0)
    half_disc = 0.5 * np.pi * (config.drawn_radius * config.pixels_per_metre) ** 2
    drawn = draw(points, config, colours=white(len(points)))
    assert drawn[outside, 0].sum() / 255.0 == pytest.approx(half_disc, abs=0.15)


def test_a_long_steep_bead_goes_over_and_under() -> None:
    x, y = (-0.1, 0.1, -0.08, -0.08, 0.08, 0.08), (0.0, 0.0, 0.1, -0.1, -0.1, 0.1)
    points = np.column_stack([x, y, (0.0, 0.1, 0.02, 0.02, 0.08, 0.08)])
    config = PictureConfig(size=512)
    image, colours = draw(points, config), bead_colours(len(points))
    meetings = np.array([[-0.08, 0.0, 0.02], [0.08, 0.0, 0.09]])
    column, row = np.floor(project(meetings, config, points.mean(axis=0))).astype(int).T
    assert image[row, column].tolist() == [colours[2].tolist(), colours[0].tolist()]


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


def test_crossing_pixels_lie_on_both_strands() -> None:
    points = curves()[5]
    crossings = find_crossings(points)
    places = np.stack([crossings.over_place, crossings.under_place], axis=1)
    bead = np.floor(places).astype(int) % 100
    along = points[bead] + (places % 1.0)[..., None] * (points[(bead + 1) % 100] - points[bead])
    for strand in (0, 1):
        assert project(along[:, strand], center=points.mean(axis=0)) == pytest.approx(
            project(crossings.over_points, center=points.mean(axis=0)), abs=1e-6
        )


# Settings and errors


def test_no_opengl_is_one_clear_line() -> None:
    code = (
        "import numpy as np; from knotgym.common.errors import KnotgymError; from"
        " knotgym.rendering.picture import PictureConfig, draw\ntry:\n    draw(np.eye(3) * 0.1,"
        " PictureConfig(renderer='mujoco'))\nexcept KnotgymError as error:\n    print(error)"
    )
    done = apart(code, MUJOCO_GL="off")
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
    first = draw(ring(), config)
    drawn: list[NDArray[np.uint8]] = []

    def work() -> None:
        drawn.append(draw(ring(), config))
        picture_mujoco._close()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    picture_mujoco._close()
    picture_mujoco._close()
    drawn.append(draw(ring(), config))
    assert len(drawn) == 2 and all(np.array_equal(first, image) for image in drawn)


@gl
def test_mujoco_leaves_the_process_without_a_word() -> None:
    code = (
        "import os, threading, numpy as np; from knotgym.rendering.picture import PictureConfig,"
        " draw;config = PictureConfig(size=16, renderer='mujoco'); thread ="
        " threading.Thread(target=draw, args=(np.eye(3) * 0.1, config));thread.start();"
        " thread.join(); draw(np.eye(3) * 0.1, config); print(os.environ.get('MUJOCO_GL'))"
    )
    done = apart(code)
    assert done.stdout.strip() == str(os.environ.get("MUJOCO_GL")) and not done.stderr


@gl
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_mujoco_refuses_to_draw_in_the_fork_of_a_process_that_drew() -> None:
    code = (
        "import os, numpy as np; from knotgym.common.errors import KnotgymError; from"
        " knotgym.rendering.picture import PictureConfig, draw\nconfig = PictureConfig(size=16,"
        " renderer='mujoco'); draw(np.eye(3) * 0.1, config); child = os.fork()\ntry:\n   "
        " draw(np.eye(3) * 0.1, config)\nexcept KnotgymError:\n   "
        " os._exit(3)\nprint(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    done = apart(code)
    assert done.stdout.strip() == "3"


@gl
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs a display of X")
def test_mujoco_draws_beside_a_window() -> None:
    code = (
        "import gymnasium as gym, knotgym; env = gym.make('knotgym/Tie-v0', nx=2,"
        " renderer='mujoco', observation='pixels', render_mode='human'); env.reset(seed=0);"
        " env.step(env.action_space.sample()); print('drawn')"
    )
    done = apart(code, "xvfb-run", "-a")
    assert done.stdout.endswith("drawn\n") and "Traceback" not in done.stderr
