"""The columns of the state file, `states.h5`: names, types, shapes, units, and how they follow.

A row is made, read, merged, verified, selected and shown by this schema alone. A column is derived
if it follows from how the rope lies: the writer computes it, a reader computes the
required ones that a file lacks, and `verify` computes all of them again. The file's attributes are
ATTRIBUTES and `state_file.DIGEST`.

After a change run `python docs/schemas.py` and `pytest tests/states`.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cached_property
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Column, Schema
from knotgym.quality import Quality
from knotgym.topology import Crossings, GaussCode, dt_text, find_crossings, knot_type, pd_text

FORMAT = "knotgym-states"
VERTICES_FORMAT = "knotgym-vertices"

ATTRIBUTES = {
    "knotgym": "version of this package",
    "mujoco": "version of MuJoCo",
    "rope": "fingerprint of the rope model, see `RopeConfig.fingerprint`",
    "engine": "the engine that moved the ropes, mujoco if not given; see `knotgym.rope.engines`",
    "config": "the generating configuration, JSON; a list of them in a merged file",
}


class RopeAtRest:
    """How a rope lies, and what follows from it, computed when it is first asked for.

    Attributes:
        points: float64 (beads, 3), metres.
    """

    def __init__(
        self, points: ArrayLike, *, code: GaussCode | None = None, quality: Quality | None = None
    ) -> None:
        """Look at a rope.

        Args:
            points: float64 (beads, 3), metres; not copied.
            code: its Gauss code, if it is known already.
            quality: all of its measures, if they are known already.
        """
        self.points: NDArray[np.float64] = np.asarray(points, dtype=np.float64)
        # what is given takes the place of the property of that name
        self.__dict__ |= {} if code is None else {"code": code}
        self.__dict__ |= {} if quality is None else {"quality": quality}

    @classmethod
    def measured(cls, points: NDArray[np.float64]) -> "list[RopeAtRest]":
        """Look at many ropes, float64 (n, beads, 3), and measure them together."""
        # here, so that reading states needs neither renderer nor compiled measures
        from knotgym.quality import measure_all, noise_survival

        ropes = [cls(rope) for rope in points]
        qualities = measure_all(points, [rope.crossings for rope in ropes])
        for rope, quality in zip(ropes, qualities, strict=True):
            rope.__dict__["quality"] = replace(quality, noise_survival=noise_survival(rope.points))
        return ropes

    @cached_property
    def crossings(self) -> Crossings:
        """The crossings in the picture."""
        return find_crossings(self.points)

    @cached_property
    def code(self) -> GaussCode:
        """The Gauss code, with chirality."""
        return self.crossings.code

    @cached_property
    def quality(self) -> Quality:
        """All measures."""
        return self.measured(self.points[None])[0].quality

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """The picture, as the environment shows it: uint8 (pixels, pixels, 3)."""
        from knotgym.rendering import PictureConfig, draw

        return draw(self.points, PictureConfig.of(len(self.points)))


def _of_code(name: str, doc: str, text_of: Callable[[GaussCode], str]) -> Column:
    return Column(name, "text", doc=doc, derived=lambda rope: text_of(rope.code))


_PICTURE = Column(
    "image", "uint8", ("pixels", "pixels", 3), "levels", "RGB, as the environment shows it"
)
_CROSSINGS = Column("nx", "int64", (), "crossings", "crossings in the picture", least=0)
_ROOT = (
    Column("qpos", "float64", ("nq",), "m, quaternions", "generalized positions, at rest"),
    Column("points", "float64", ("beads", 3), "m", "vertices of the rope, z up"),
    _PICTURE._replace(derived=attrgetter("image")),
    _of_code("gauss_code", "Gauss code, such as `1+,1-,2+,2-`", str),
    _of_code(
        "gauss_code_chiral",
        "Gauss code with chirality, such as `1+a,1-a,2+c,2-c`",
        attrgetter("chiral"),
    ),
    _of_code("pd_code", "PD code, such as `[[1,1,2,2]]`", pd_text),
    _of_code("dt_code", "DT code, such as `[4, 6, 2]`", dt_text),
    _of_code("knot", "knot type, `0_1` for the unknot", knot_type),
    _CROSSINGS._replace(derived=attrgetter("code.nx")),
    Column("split", "text", (), "", "`train` or `test`"),
)
_MEASURES = tuple(
    Column(
        f"quality/{measure.name}",
        "float64",
        unit=measure.metadata["unit"],
        doc=measure.metadata["doc"],
        optional=True,
        derived=attrgetter(f"quality.{measure.name}"),
    )
    for measure in fields(Quality)
)
_SOURCE = (
    Column("start_qpos", "float64", ("nq",), "m, quaternions", "where the rope was laid at rest"),
    Column("actions", "float32", ("actions", 6), "[-1, 1]", "actions from there", padded=True),
    Column("steps", "int64", (), "actions", "number of actions", least=0),
    Column("seed", "int64", (5,), "", "key of the row's random stream; each rope has its own"),
    Column("policy", "text", (), "", "where it comes from: `drawing`, `play`, `random-walk`, ..."),
    Column("dataset", "text", (), "", "dataset below `minari/` with the demonstration, or empty"),
    Column("trajectory", "int64", (), "", "episode of that dataset, or -1; the rope of a walk"),
    Column("step", "int64", (), "actions", "last state of that episode"),
    Column("drawing", "text", (), "", "parameters of the drawing of `start_qpos`, JSON, or empty"),
)


def _finite(column: Column) -> Column:
    """Refuse infinity and NaN in what a rope is laid from."""
    return column._replace(finite=column.dtype[:5] == "float")


STATES = Schema(
    "",
    (
        *map(_finite, _ROOT),
        *_MEASURES,
        *(_finite(c)._replace(name=f"source/{c.name}", optional=True) for c in _SOURCE),
    ),
    "a rope at rest",
)
# The form of large sets: the rope is laid from its vertices, rounded, and all else is computed.
_KEPT = ("points", "gauss_code_chiral", "knot", "split", "source/policy", "source/trajectory")
VERTICES = Schema(
    "",
    tuple(
        column._replace(
            optional=False, dtype="float32" if column.name == "points" else column.dtype
        )
        for column in STATES.only(*_KEPT).columns
    ),
    "a rope at rest, by its vertices",
)
