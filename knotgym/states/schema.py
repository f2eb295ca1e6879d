"""The columns of the state file, `states.h5`: names, types, shapes and units.

Reading, writing, merging, verification and the documentation use this schema. The file's attributes
are ATTRIBUTES and DIGEST.
"""

from collections.abc import Iterable

from knotgym.common import Column, Schema
from knotgym.quality import UNITS

FORMAT = "knotgym-states"

ATTRIBUTES = {
    "knotgym": "version of this package",
    "mujoco": "version of MuJoCo",
    "rope": "fingerprint of the rope model, see `RopeConfig.fingerprint`",
    "engine": "the engine that moved the ropes, mujoco if not given; see `knotgym.rope.engines`",
    "config": "the generating configuration, JSON; a list of them in a merged file",
}
DIGEST = "content_sha256"  # attribute: `common.tables.digest` of the file's table

# values of source/policy; files of curated states have "demonstrations"
RANDOM_WALK, DRAWING, PLAY, IMPORT = "random-walk", "drawing", "play", "import"

_MEASURES = {
    "crossing_angle": "smallest angle between two crossing strands",
    "crossing_spacing": "smallest distance between two crossings",
    "base_spacing": "distance along the rope from the base bead to the nearest crossing",
    "strand_spacing": "smallest distance between different strands",
    "smallest_region": "area of the smallest enclosed region of background",
    "smallest_face": "area of the smallest region that the rope's axis encloses",
    "margin": "distance from the rope's edge to the picture's edge",
    "clearance": "smallest height of an over strand above its under strand",
    "excess_crossing_number": "average crossing number minus the crossings in the picture",
    "total_curvature": "total turning of the rope's direction",
    "writhe": "sum of the crossing signs",
    "noise_survival": "share of 64 draws of reset noise that keep the code",
}

_ROOT = (
    Column("qpos", "float64", ("nq",), "m, quaternions", "generalized positions, at rest"),
    Column("points", "float64", ("beads", 3), "m", "vertices of the rope, z up"),
    Column("image", "uint8", ("pixels", "pixels", 3), "levels", "RGB, as the environment shows it"),
    Column("gauss_code", "text", (), "", "Gauss code, such as `1+,1-,2+,2-`"),
    Column("gauss_code_chiral", "text", (), "", "the same with chirality: `1+a,1-a,2+c,2-c`"),
    Column("pd_code", "text", (), "", "PD code, such as `[[1,1,2,2]]`"),
    Column("dt_code", "text", (), "", "DT code, such as `[4, 6, 2]`"),
    Column("knot", "text", (), "", "knot type, `0_1` for the unknot"),
    Column("nx", "int64", (), "crossings", "crossings in the picture", least=0),
    Column("split", "text", (), "", "`train` or `test`"),
)
_SOURCE = (
    Column("start_qpos", "float64", ("nq",), "m, quaternions", "where the rope was laid at rest"),
    Column("actions", "float32", ("actions", 6), "[-1, 1]", "actions from there"),
    Column("steps", "int64", (), "actions", "number of actions", least=0),
    Column("seed", "int64", (5,), "", "key of the row's random stream; each rope has its own"),
    Column("policy", "text", (), "", "`drawing`, `play`, `random-walk`, `import`"),
    Column("dataset", "text", (), "", "dataset below `minari/` with the demonstration, or empty"),
    Column("trajectory", "int64", (), "", "episode of that dataset, or -1; the rope of a walk"),
    Column("step", "int64", (), "actions", "last state of that episode"),
    Column("drawing", "text", (), "", "parameters of the drawing of `start_qpos`, JSON, or empty"),
)


def _columns(prefix: str, columns: Iterable[Column]) -> tuple[Column, ...]:
    """Name columns by their group. Positions and actions are finite; groups may be incomplete."""
    return tuple(
        column._replace(
            name=prefix + column.name,
            optional=column.optional or bool(prefix),
            finite=column.dtype[:5] == "float" and prefix != "quality/",
        )
        for column in columns
    )


STATES = Schema(
    "",
    (
        *_columns("", _ROOT),
        *_columns(
            "quality/",
            (Column(name, "float64", (), UNITS[name], doc) for name, doc in _MEASURES.items()),
        ),
        *_columns("source/", _SOURCE),
    ),
    "a rope at rest",
)
# the form of large sets: the rope is laid from its vertices, and all else is computed from it
VERTICES_FORMAT = "knotgym-vertices"
VERTICES = Schema(
    "",
    (
        Column("points", "float32", ("beads", 3), "m", "vertices, z up", finite=True),
        Column("gauss_code_chiral", "text", (), "", "Gauss code with chirality"),
        Column("knot", "text", (), "", "knot type, `0_1` for the unknot"),
        Column("split", "text", (), "", "`train` or `test`"),
        Column("source/policy", "text", (), "", "where it was met: `bench-play`, `bench-drawing`"),
        Column("source/trajectory", "int64", (), "", "the rope, or the drawing"),
    ),
    "a rope at rest, by its vertices",
)
WITHOUT_IMAGES = STATES.only(*(column.name for column in STATES.columns if column.name != "image"))
