"""Draw a rope and its crossings in a client's viser scene.

viser 1.1 was chosen because it gives drags on single instances of a batched mesh, hot keys and
images, needs no build step, and is what robotics users know; mjswan runs MuJoCo in the browser, so
its rope would not be the one that is recorded. The scene is in decimetres: viser's nearest plane
and its controls are made for objects of that size.
"""

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from knotgym.common import Array
from knotgym.rendering import bead_colours
from knotgym.rope import RopeConfig
from knotgym.topology import find_crossings

SCALE = 10.0  # scene units per metre
_LATITUDES, _SIDES = 7, 10  # of a bead's drawn capsule
_HEIGHT = 4.5  # scene units above the rope from which viser's camera, of 75 degrees, sees all
_NARROW = 0.8  # width by height of a tab, below which it is a phone's
_FLAT: dict[str, Any] = {"lod": "off", "cast_shadow": False, "receive_shadow": False}
_GRIP = 3.0  # radius within which a finger takes a bead on a phone, in rope radii


class RopeScene:
    """A rope in one client's scene.

    Attributes:
        narrow: whether the tab is a phone's, over the lower 60 % of which viser lays its panel.
        goal_size: pixels of a goal's picture that leave room for the buttons.
        grips: the handle of the batched mesh on which drags arrive with the bead's index.
    """

    def __init__(self, client: Any, points: Array, rope: RopeConfig) -> None:
        self._client = client
        client.scene.add_light_ambient("/light", intensity=0.6)
        self.narrow = client.camera.image_width < _NARROW * client.camera.image_height
        self.goal_size = 128 if self.narrow else 192
        self._meshes = [self._capsules("/rope", points, rope, rope.radius, None)]
        if self.narrow:
            self._meshes.append(self._capsules("/grips", points, rope, _GRIP * rope.radius, 0.0))
        self.grips = self._meshes[-1]
        self._marks = list[Any]()

    def _capsules(
        self, name: str, points: Array, rope: RopeConfig, radius: float, opacity: float | None
    ) -> Any:
        vertices, faces = _capsule(radius * SCALE, rope.bead_length * SCALE)
        turns, middles = _poses(points)
        return self._client.scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            turns,
            middles,
            batched_colors=bead_colours(len(points)),
            opacity=opacity,
            **_FLAT,
        )

    def look_from_above(self, points: Array) -> None:
        """Move the camera above the rope, as the published pictures are taken.

        On a phone the rope is shown in the upper 40 %, above the panel.
        """
        middle, camera = SCALE * points.mean(axis=0), self._client.camera
        height = _HEIGHT
        if self.narrow:
            height *= 2
            middle[1] -= 0.6 * height * np.tan(np.radians(75 / 2))
        camera.up_direction = (0.0, 1.0, 0.0)
        camera.position = middle + np.array([0.0, 0.0, height])
        camera.look_at = middle

    def move(self, points: Array, *, mark: bool = False) -> None:
        """Show the rope with other vertices, float64 (beads, 3), metres; `mark` its crossings."""
        turns, middles = _poses(points)
        with self._client.atomic():
            for mesh in self._meshes:
                mesh.batched_wxyzs = turns
                mesh.batched_positions = middles
        if mark:
            self._mark(points)

    def _mark(self, points: Array) -> None:
        """Write each crossing's number and sign beside it, in the order of a walk."""
        crossings = find_crossings(points)
        first = np.minimum(crossings.over_place, crossings.under_place)
        with self._client.atomic():
            for mark in self._marks:
                mark.remove()
            self._marks = []
            for number, row in enumerate(np.argsort(first), start=1):
                sign = "+" if crossings.over_place[row] < crossings.under_place[row] else "-"
                add, at = self._client.scene.add_label, SCALE * crossings.over_points[row]
                at[2] += 0.15
                self._marks.append(add(f"/crossings/{number}", f"{number}{sign}", position=at))


def _poses(points: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the beads' quaternions (n, 4), w first, and middles (n, 3) in scene units.

    A bead's mesh lies along x. The shortest rotation from x to a unit vector d has the quaternion
    (1 + x.d, x cross d), normalized.
    """
    ends = np.roll(points, -1, axis=0)
    along = (ends - points) / np.linalg.norm(ends - points, axis=1, keepdims=True)
    turns = np.stack([1 + along[:, 0], np.zeros(len(points)), -along[:, 2], along[:, 1]], axis=1)
    opposite = np.linalg.norm(turns, axis=1) < 1e-6  # d = -x: half a turn about z
    turns[opposite] = 0.0, 0.0, 0.0, 1.0
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    middles = SCALE * (points + ends) / 2
    return turns.astype(np.float32), middles.astype(np.float32)


def _capsule(radius: float, length: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the vertices (n, 3) and faces (m, 3) of a capsule along x, about the origin."""
    mesh = trimesh.creation.capsule(length, radius, count=(_LATITUDES, _SIDES))  # along z
    vertices = (mesh.vertices - mesh.bounds.mean(axis=0))[:, [2, 0, 1]]
    return vertices.astype(np.float32), mesh.faces.astype(np.uint32)
