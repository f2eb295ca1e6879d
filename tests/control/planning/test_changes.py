import numpy as np
import pytest

from knotgym.control.planning import changes, shipped_guide
from knotgym.control.planning.changes import Example, Guide, Proposals
from knotgym.control.planning.moves import MoveRow, Moves
from knotgym.control.planning.sights import Diagram
from knotgym.rope import Rope
from knotgym.topology import GaussCode, with_chirality

FLAT, KINK = GaussCode(), GaussCode.parse("1+a,1-a")
TREFOIL = GaussCode.parse("1+a,2-a,3+a,1-a,2+a,3-a")


@pytest.mark.parametrize(
    ("goal", "far", "hops"),
    [
        ("1+,1-", 4.563417890520695, 1),
        ("1-,2+,2-,1+", 44.66019208406908, 2),
        ("1+,1-,2+,2-,3+,4-,4+,3-", 111.61841227884841, 5),
        ("1+,2-,3+,1-,2+,3-", 90.0, None),  # another knot: three crossings too few
    ],
)
def test_distances_from_the_plain_loop_are_those_counted(
    goal: str, far: float, hops: int | None
) -> None:
    code = GaussCode.parse(goal)
    distances = shipped_guide().to(code, FLAT)
    assert distances(FLAT) == far and distances.hops(FLAT) == hops
    assert distances(with_chirality(code)) == 0.0


def test_changes_lead_nearer_and_have_examples() -> None:
    nearer = shipped_guide().to(KINK, FLAT).nearer(FLAT)
    assert len(nearer) > 1 and all(change.promise > 0 and change.examples for change in nearer)


def test_single_moves_lead_to_goals_beyond_the_table() -> None:
    goal = GaussCode.parse("1+,1-,2+,2-,3+,3-,4+,4-,5+,5-,6+,6-")
    distances = shipped_guide().to(goal, FLAT)
    one_less = with_chirality(GaussCode.parse("1+,1-,2+,2-,3+,3-,4+,4-,5+,5-"))
    assert distances.hops(one_less) == 1 and (distances.hops(FLAT) or 0) >= 6
    assert distances(with_chirality(goal)) == 0.0 < distances(one_less) < distances(FLAT)
    assert any(len(change.examples) > 1 for change in distances.nearer(one_less))


def test_without_a_table_crossings_alone_guide() -> None:
    distances = Guide(Moves(), {}).to(FLAT, FLAT)
    assert distances(KINK) == 30.0 and distances(TREFOIL) == 90.0
    assert distances.hops(KINK) is None and distances.nearer(KINK) == []


def test_an_image_of_an_example_is_undone_by_the_same_symmetry() -> None:
    example = Example(1, 0.25, 2.5)
    for image in range(8):
        assert example.image(image, 3).image(image, 3) == example
    assert example.image(0b110, 3) == Example(-1, 2.75, 0.5)
    assert Example(0, 1.0, -2.0).image(4, 3) == Example(0, 2.0, -2.0)


def test_proposals_imitate_what_made_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    points, rng = Rope().loop(), np.random.default_rng(0)
    examples = [Example(1, 0.3, 0.5)]
    row = MoveRow(Diagram(FLAT), 0, Diagram(KINK), 5, 10)
    guide = Guide(Moves([row]), {(Diagram(FLAT), 0): examples})
    nearer = guide.to(KINK, FLAT).nearer(FLAT)
    monkeypatch.setattr(changes, "GUIDED", 1.0)
    monkeypatch.setattr(changes, "TEMPLATE_NOISE", 0.0)
    moves = [Proposals(nearer).draw(points, rng) for _ in range(40)]
    assert {(move.bead, move.target) for move in moves} == {(30, 50), (70, 50)}
