"""The columns of the state file, `states.h5`: names, types, shapes and units.

Reading, writing, merging and verification all use this list. The file's attributes are `format`,
`format_version`, ATTRIBUTES and DIGEST; `quality/*` may contain further measures.
"""

from knotgym.common.hdf5_files import Column
from knotgym.quality.limits import UNITS

FORMAT = "knotgym-states"
FORMAT_VERSION = 1

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
DIGEST = "content_sha256"  # attribute: checksum of all columns, see `states.content_digest`

ROOT = (
    Column(
        "qpos", "float64", ("nq",), "m, quaternions", "generalized positions, at rest", finite=True
    ),
    Column("points", "float64", ("beads", 3), "m", "vertices of the rope, z up", finite=True),
    Column("image", "uint8", (None, None, 3), "levels", "RGB, as the environment renders it"),
    Column("gauss_code", "text", (), "", 'such as "1+,1-,2+,2-"'),
    Column("gauss_code_chiral", "text", (), "", 'such as "1+a,1-a,2+c,2-c"'),
    Column("pd_code", "text", (), "", 'PD code, such as "[[1,1,2,2]]", see `topology.notation`'),
    Column("dt_code", "text", (), "", 'DT code, such as "[4, 6, 2]"'),
    Column("knot", "text", (), "", 'knot type, such as "0_1"'),
    Column("nx", "int64", (), "crossings", "crossings in the picture", least=0),
    Column("split", "text", (), "", '"train" or "test"'),
)
QUALITY = tuple(
    Column(f"quality/{name}", "float64", (), unit, "see `knotgym.quality.limits.Quality`")
    for name, unit in UNITS.items()
)
# A rope laid at rest at start_qpos and stepped with the first `steps` actions ends in the row's
# qpos bit for bit. If `policy` is RANDOM_WALK in all rows, there is no column of actions: they come
# from the row's random stream (`knotgym.rope.actions.drawn_actions`).
SOURCE = (
    Column("source/start_qpos", "float64", ("nq",), "m, quaternions", "at rest", finite=True),
    Column("source/actions", "float32", (None, 6), "", "actions, padded with zeros", finite=True),
    Column("source/steps", "int64", (), "actions", "number of actions", least=0),
    Column("source/seed", "int64", (None,), "", "key of the state's random stream"),
    Column("source/policy", "text", (), "", "policy that acted"),
    Column("source/dataset", "text", (), "", "Minari dataset of the demonstration"),
    Column("source/trajectory", "int64", (), "", "episode of that dataset; the walk's rope; or -1"),
    Column("source/step", "int64", (), "actions", "state of that episode"),
    Column("source/drawing", "text", (), "", '"" or parameters of the drawing, JSON'),
)
COLUMNS = (*ROOT, *QUALITY, *SOURCE)

# values of source/policy; files of curated states have "demonstrations"
RANDOM_WALK, DRAWING, PLAY, IMPORT = "random-walk", "drawing", "play", "import"

# columns that reproducing a row needs
REPLAYED = ("source/start_qpos", "source/actions", "source/steps", "source/seed")
