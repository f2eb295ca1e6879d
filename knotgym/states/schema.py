"""The columns of the state file, `states.h5`: names, types, shapes and units.

Reading, writing, merging, verification and the documentation use this schema. The file's attributes
are ATTRIBUTES and DIGEST.
"""

from knotgym.common.tables import Column, Schema
from knotgym.quality.limits import UNITS

FORMAT = "knotgym-states"

STATE_SPLITS = ("train", "test")
# parts of "train" and "test" without a common diagram, see `States.rows`
CODE_SPLITS = ("train-code", "test-code")

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

ROOT = (
    Column(
        "qpos", "float64", ("nq",), "m, quaternions", "generalized positions, at rest", finite=True
    ),
    Column("points", "float64", ("beads", 3), "m", "vertices of the rope, z up", finite=True),
    Column(
        "image", "uint8", ("pixels", "pixels", 3), "levels", "RGB, as the environment renders it"
    ),
    Column("gauss_code", "text", (), "", "Gauss code, such as `1+,1-,2+,2-`"),
    Column("gauss_code_chiral", "text", (), "", "the same with chirality: `1+a,1-a,2+c,2-c`"),
    Column("pd_code", "text", (), "", "PD code, such as `[[1,1,2,2]]`"),
    Column("dt_code", "text", (), "", "DT code, such as `[4, 6, 2]`"),
    Column("knot", "text", (), "", "knot type, `0_1` for the unknot"),
    Column("nx", "int64", (), "crossings", "crossings in the picture", least=0),
    Column("split", "text", (), "", "`train` or `test`"),
)
QUALITY = tuple(
    Column(f"quality/{name}", "float64", (), UNITS[name], doc, optional=True)
    for name, doc in _MEASURES.items()
)
# A rope laid at rest at start_qpos and stepped with the first `steps` actions ends in the row's
# qpos bit for bit.
SOURCE = tuple(
    column._replace(optional=True)
    for column in (
        Column(
            "source/start_qpos",
            "float64",
            ("nq",),
            "m, quaternions",
            "where the rope was laid at rest",
            finite=True,
        ),
        Column(
            "source/actions",
            "float32",
            ("actions", 6),
            "[-1, 1]",
            "actions from there, padded with zeros; without this column they are drawn from `seed`",
            finite=True,
        ),
        Column("source/steps", "int64", (), "actions", "number of actions", least=0),
        Column(
            "source/seed",
            "int64",
            (5,),
            "",
            "key of the row's random stream; rows with the same key come from one rope",
        ),
        Column(
            "source/policy",
            "text",
            (),
            "",
            "`drawing`, `play`, `random-walk` or `import`; `demonstrations` in the curated sets",
        ),
        Column(
            "source/dataset",
            "text",
            (),
            "",
            "id of the dataset below `minari/` with the row's demonstration, empty without one",
        ),
        Column(
            "source/trajectory",
            "int64",
            (),
            "",
            "episode of that dataset, -1 without one; for random walks the rope",
        ),
        Column("source/step", "int64", (), "actions", "last state of that episode"),
        Column(
            "source/drawing",
            "text",
            (),
            "",
            "parameters of the drawing of `start_qpos`, JSON; empty if it was not drawn",
        ),
    )
)
STATES = Schema("", (*ROOT, *QUALITY, *SOURCE), "a rope at rest")
WITHOUT_IMAGES = STATES.only(*(column.name for column in STATES.columns if column.name != "image"))
