"""The columns of the state file, `states.h5`: their names, types, shapes and units.

What is read, written, merged and verified follows this one list. The file's attributes are `format`
and `format_version`, ATTRIBUTES and DIGEST; `quality/*` may hold other measures too.
"""

from __future__ import annotations

from knotgym.common.hdf5_files import Column
from knotgym.quality.limits import UNITS

FORMAT = "knotgym-states"
FORMAT_VERSION = 1

STATE_SPLITS = ("train", "test")
# parts of "train" and "test" that share no diagram, see `States.rows`
CODE_SPLITS = ("train-code", "test-code")

ATTRIBUTES = {
    "knotgym": "version of this package",
    "mujoco": "version of MuJoCo",
    "rope": "fingerprint of the rope model, see `RopeConfig.fingerprint`",
    "config": "the generating configuration, JSON; a list of them in a merged file",
}
DIGEST = "content_sha256"  # an attribute too: of all columns, see `states.content_digest`

ROOT = (
    Column(
        "qpos",
        "float64",
        ("nq",),
        "m, quaternions",
        "MuJoCo generalized positions, at rest",
        finite=True,
    ),
    Column("points", "float64", ("beads", 3), "m", "vertices of the rope, z up", finite=True),
    Column("image", "uint8", (None, None, 3), "levels", "RGB, as the environment shows it"),
    Column("gauss_code", "text", (), "", 'as "1+,1-,2+,2-"'),
    Column("gauss_code_chiral", "text", (), "", 'as "1+a,1-a,2+c,2-c"'),
    Column("knot", "text", (), "", 'knot type, as "0_1"'),
    Column("nx", "int64", (), "crossings", "how many the picture shows", least=0),
    Column("split", "text", (), "", '"train" or "test"'),
)
QUALITY = tuple(
    Column(f"quality/{name}", "float64", (), unit, "see `knotgym.quality.limits.Quality`")
    for name, unit in UNITS.items()
)
# Laid at rest at start_qpos, a rope that takes the first `steps` actions ends in the row's qpos bit
# for bit. A file whose `policy` is RANDOM_WALK in all rows has no column of actions: those of a row
# are drawn from its stream (`knotgym.rope.actions.drawn_actions`).
SOURCE = (
    Column(
        "source/start_qpos",
        "float64",
        ("nq",),
        "m, quaternions",
        "where the rope is laid",
        finite=True,
    ),
    Column(
        "source/actions", "float32", (None, 6), "", "taken from there on; then zeros", finite=True
    ),
    Column("source/steps", "int64", (), "actions", "how many of them are taken", least=0),
    Column("source/seed", "int64", (None,), "", "key of the random stream it was drawn from"),
    Column("source/policy", "text", (), "", "who acted"),
    Column("source/dataset", "text", (), "", "Minari dataset that its demonstration is in"),
    Column("source/trajectory", "int64", (), "", "its episode in that dataset; a rope"),
    Column("source/step", "int64", (), "actions", "state of that episode"),
    Column("source/drawing", "text", (), "", 'how start_qpos was drawn, JSON; "" if it was not'),
)
COLUMNS = (*ROOT, *QUALITY, *SOURCE)

RANDOM_WALK, DRAWING = "random-walk", "drawing"  # in source/policy

# without these a row can't be made again
REPLAYED = ("source/start_qpos", "source/actions", "source/steps", "source/seed")
