import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from knotgym.control import Sight
from knotgym.control.planning.sights import Diagram
from knotgym.rope import Array
from knotgym.topology import Symmetry, find_crossings

ANGLES = np.linspace(0, 2 * np.pi, 40, endpoint=False)


def diagram_of(points: Array) -> Diagram:
    return Sight.of(points[None])[0].diagram


@given(reverse=st.booleans(), switch=st.booleans(), reflect=st.booleans(), turn=st.floats(0, 6.28))
def test_a_symmetry_of_the_rope_is_the_same_symmetry_of_its_diagram(
    curve: Array, reverse: bool, switch: bool, reflect: bool, turn: float
) -> None:
    moved = Symmetry(reflect=reflect, switch=switch, turn=turn, reverse=reverse)
    image = diagram_of(moved.vertices(curve))
    assert image == diagram_of(curve).image(4 * reverse + 2 * switch + reflect)
    assert image.nx >= 2
    assert image.canonical()[0] == diagram_of(curve).canonical()[0]


def test_a_kink_inside_the_loop_is_told_from_one_outside() -> None:
    radius, height = 1 + 1.8 * np.cos(ANGLES), 0.1 * np.sin(ANGLES + 1)
    inside = np.stack([radius * np.cos(ANGLES), radius * np.sin(ANGLES), height], axis=1)
    eight = np.stack([np.sin(2 * ANGLES + 0.1), np.sin(ANGLES + 0.05), height], axis=1)
    one, other = diagram_of(inside), diagram_of(eight)
    assert one.nx == other.nx == 1
    assert len(one.outer) == 1 and len(other.outer) == 2


def test_arcs_end_where_crossings_are_visited(curve: Array) -> None:
    (sight,), crossings = Sight.of(curve[None]), find_crossings(curve)
    visits = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))
    assert list(sight.cuts) == [0.0, *visits, 40.0]


def test_a_bead_is_where_its_position_says(curve: Array) -> None:
    (sight,) = Sight.of(curve[None])
    assert [sight.bead(sight.position(bead)) for bead in range(40)] == list(range(40))
    assert sight.bead(-1.0) == 0 and sight.bead(99.0) == sight.bead(2 * sight.diagram.nx + 1)
