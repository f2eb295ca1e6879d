"""A column that is declared in the schema is in every file, card, page, selection and check."""

from pathlib import Path

from ..fresh_interpreter import python

# what a stranger adds to the schema: one line; the rest is what every user does with states
SCRIPT = """
import numpy as np
from knotgym.common import Column
from knotgym.states import schema
height = Column(
    "height", "float64", unit="m", doc="from the lowest to the highest vertex", optional=True,
    derived=lambda rope: float(np.ptp(rope.points[:, 2])),
)
schema.STATES = schema.STATES._replace(columns=(*schema.STATES.columns, height))

from knotgym import verify
from knotgym.cli import main
from knotgym.states import merge_states, read_states, write_states

def knotgym(*words):
    try:
        main([*words])
    except SystemExit as ended:
        return ended.code

assert knotgym("generate", "--nx", "0,1", "--count", "2", "--no-demonstrations",
               "--engine", "chain", "--workers", "1", "--out", "set") == 0
made = read_states("set/states.h5")
assert np.array_equal(made.table["height"], np.ptp(made.points[..., 2], axis=1))
card = open("set/README.md").read()
assert "| `height` | float64 | m | optional; from the lowest to the highest vertex |" in card
assert "| height | m | " in card, "the table of measures"
assert verify("set") == []
low = float(np.median(made.table["height"]))
assert knotgym("dataset", "select", "set", "--where", f"height > {low}", "--out", "high.h5") == 0
assert read_states("high.h5").table["height"].min() > low
assert knotgym("dataset", "page", "set", "--out", "page.html") == 0
assert '"name":"height","unit":"m"' in open("page.html").read()

# an old file has no such column: it is read, verified, and merged, when the column is computed
old = made.take([0, 2])
old = type(old)(old.table.only(*(name for name in old.table if name != "height")), old.attributes)
write_states("old.h5", old)
assert "height" not in read_states("old.h5").table
assert verify("old.h5") == []
both = merge_states([read_states("old.h5"), made.take([1, 3])])
assert np.array_equal(both.table["height"], np.ptp(both.points[..., 2], axis=1))
write_states("new.h5", made.take([1, 3]))
assert knotgym("dataset", "merge", "old.h5", "new.h5", "--out", "merged.h5") == 0
assert verify("merged.h5") == []

write_states("wrong.h5", made.replaced({"height": made.table["height"] + 0.01}))
assert any("row 0: height is" in fault for fault in verify("wrong.h5"))
"""


def test_a_derived_column_is_one_line(tmp_path: Path) -> None:
    done = python("-c", SCRIPT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
