"""Pictures of a rope drawn by MuJoCo's classic renderer, through OpenGL.

This module is imported only for pictures with renderer="mujoco". OpenGL contexts are expensive and
belong to one thread of one process, so one is kept for each (process, thread, canvas size). They
are held nowhere else, so environments can be pickled. Drawing in a child forked from a process that
has drawn is refused, because drivers hang there.

The backend is the user's MUJOCO_GL; if that is unset, EGL if installed, otherwise OSMesa, otherwise
a window system. The environment variable itself is never written.

After a change run `pytest tests/rendering/test_picture.py` where OpenGL works: both renderers must
draw the same picture.
"""

import atexit
import ctypes.util
import importlib
import math
import os
import platform
import threading
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Failed, one_line
from knotgym.rendering.camera import NEAR, PictureConfig

_MARGIN = 0.5  # free space above and below the rope, metres
_SAMPLES = 4  # along each side of a pixel, averaged

# Only ambient light, so that colours are flat; no multisampling (offsamples), which
# drivers do each in their own way.
_STAGE = """
<mujoco><worldbody/><visual>
  <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/>
  <quality offsamples="0" shadowsize="0" numslices="24" numstacks="12" numquads="1"/>
  <global offwidth="{side}" offheight="{side}"/>
</visual></mujoco>
"""


_REMEDY = (
    "install EGL (libegl1) or OSMesa (libosmesa6), set MUJOCO_GL to one that works, or use"
    " renderer='opencv', which needs no OpenGL"
)


class _Painter:
    """An OpenGL canvas and its scene, usable only in the thread that created it.

    Args:
        side: side of the canvas, pixels.

    Raises:
        Failed: no OpenGL context can be created.
    """

    def __init__(self, side: int) -> None:
        backend = _backend()
        model = mujoco.MjModel.from_xml_string(_STAGE.format(side=side))
        try:
            self._gl: Any = importlib.import_module(f"mujoco.{backend}").GLContext(side, side)
            self._gl.make_current()
            self._context: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        # backends raise ImportError, AttributeError, RuntimeError, GLError or FatalError
        except Exception as error:
            raise _unavailable(f"{backend}: {one_line(error) or type(error).__name__}") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._model, self._side = model, side

    def __call__(
        self, points: Array, colours: NDArray[np.uint8], config: PictureConfig
    ) -> NDArray[np.uint8]:
        """Paint a rope on the canvas.

        Args:
            points: float64, shape (beads, 3), metres.
            colours: uint8, shape (beads, 3), RGB.
            config: settings of the picture.

        Returns:
            uint8, shape (side, side, 3), row 0 at the top, before averaging to the picture's size.
        """
        points = points - points.mean(axis=0)
        scene = _stage(self._model, points, config)
        rgba = np.column_stack([colours / 255.0, np.ones(len(points))]).astype(np.float32)
        capsule, following = mujoco.mjtGeom.mjGEOM_CAPSULE.value, np.roll(points, -1, axis=0)
        for geom, here, there, colour in zip(scene.geoms, points, following, rgba, strict=True):
            # only the colour counts here: the connector sets size, place and direction
            mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            mujoco.mjv_connector(geom, capsule, config.drawn_radius, here, there)
        scene.ngeom = len(points)
        # a painter of another size may have been the current one of this thread
        self._gl.make_current()
        canvas = np.empty((self._side, self._side, 3), dtype=np.uint8)
        depth = np.empty((self._side, self._side), dtype=np.float32)
        view = mujoco.MjrRect(0, 0, self._side, self._side)
        mujoco.mjr_render(view, scene, self._context)
        mujoco.mjr_readPixels(canvas, depth, view, self._context)
        # where nothing was drawn the depth is still that of the far plane
        canvas[depth == 1.0] = config.background
        # OpenGL's first row is the bottom one
        return np.ascontiguousarray(canvas[::-1])

    def free(self) -> None:
        """Free the context."""
        self._gl.make_current()
        # the context first, as it can only be freed while its canvas is there
        self._context.free()
        self._gl.free()


# (process, thread, side of the canvas) -> painter; a fork has those of its ancestors, too
_painters: dict[tuple[int, int, int], _Painter] = {}


def draw(points: Array, colours: NDArray[np.uint8], config: PictureConfig) -> NDArray[np.uint8]:
    """Draw one rope; `knotgym.rendering.picture.draw` documents and checks the arguments.

    Raises:
        Failed: no OpenGL context can be created.
    """
    side = config.size * _SAMPLES
    key = (os.getpid(), threading.get_ident(), side)
    if key not in _painters:
        if {process for process, *_ in _painters} - {key[0]}:
            raise _unavailable(
                "this process was forked from one that had drawn already",
                "start workers by 'spawn' or 'forkserver', or use renderer='opencv'",
            )
        _painters[key] = _Painter(side)
        # registered after a context, so that it runs before the backend's own exit handler
        atexit.register(_close)
    picture = _painters[key](points, colours, config)
    # halving twice is three times as fast as one reduction by four
    for shrunk in (2 * config.size, config.size):
        picture = np.asarray(cv2.resize(picture, (shrunk, shrunk), interpolation=cv2.INTER_AREA))
    return picture


def _close() -> None:
    """Free the contexts that this thread of this process has created."""
    for key in [key for key in _painters if key[:2] == (os.getpid(), threading.get_ident())]:
        _painters.pop(key).free()


def _stage(model: mujoco.MjModel, points: Array, config: PictureConfig) -> mujoco.MjvScene:
    """Create an empty scene, lit evenly from all sides, with the camera as config says.

    Points (beads, 3) are relative to their mean; there is room for one geom for each.
    """
    scene, everything = mujoco.MjvScene(model, len(points)), mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(
        model, mujoco.MjData(model), mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene
    )
    for flag in ("SHADOW", "REFLECTION", "FOG", "HAZE", "SKYBOX"):
        scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
    if config.fovy is None:
        # rays are parallel, so any height above the rope shows the same
        height = float(points[:, 2].max()) + _MARGIN
        half = 0.5 * config.view / config.zoom
    else:
        height = config.camera_height
        # MuJoCo's frustum is given at the near plane
        half = NEAR * math.tan(0.5 * math.radians(config.fovy)) / config.zoom
    # a scene has two cameras, one for each eye; MuJoCo draws from between them
    for camera in scene.camera:
        camera.pos, camera.forward = [0.0, 0.0, height], [0.0, 0.0, -1.0]
        camera.up = [-math.sin(config.turn), math.cos(config.turn), 0.0]
        camera.orthographic = int(config.fovy is None)
        camera.frustum_center, camera.frustum_width = 0.0, half
        camera.frustum_bottom, camera.frustum_top = -half, half
        camera.frustum_near = NEAR
        camera.frustum_far = height - float(points[:, 2].min()) + _MARGIN
    return scene


def _unavailable(reason: str, remedy: str = _REMEDY) -> Failed:
    return Failed(f"no OpenGL for renderer='mujoco' ({reason}); {remedy}")


def _backend() -> str:
    """Return the MuJoCo module that creates contexts: egl, osmesa, glfw or cgl."""
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen in ("egl", "osmesa", "glfw", "cgl"):
        return chosen
    if chosen in ("disable", "disabled", "off", "false", "0"):
        raise _unavailable(f"MUJOCO_GL={chosen}")
    if platform.system() != "Linux":
        return "cgl" if platform.system() == "Darwin" else "glfw"
    for library in ("EGL", "OSMesa"):
        if ctypes.util.find_library(library):
            return library.lower()
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return "glfw"
    raise _unavailable("neither libEGL nor libOSMesa is installed and there is no display")
