from pathlib import Path

import numpy as np
import pytest

from knotgym.common import InvalidFile
from knotgym.control.planning import moves
from knotgym.control.planning.moves import KINDS, MoveKind, Moves, PassTemplate
from knotgym.control.planning.sights import IMAGES, Diagram
from knotgym.topology import GaussCode, chiralities, codes_of

CODES = [
    GaussCode(code.visits, letters)
    for nx in range(4)
    for knot in ("0_1", "3_1")
    for code in codes_of(knot, nx)
    for letters in chiralities(code)
]
GOAL = GaussCode.parse("1+,2+,2-,1-")


def random_table(seed: int) -> Moves:
    """Moves between random codes: with up to four outcomes each."""
    rng = np.random.default_rng(seed)
    rows = []
    for label in range(60):
        before = Diagram(CODES[rng.integers(len(CODES))])
        tried = int(rng.integers(10, 30))
        for after in rng.choice(len(CODES), size=int(rng.integers(1, 5)), replace=False):
            rows.append((before, label, Diagram(CODES[after]), int(rng.integers(1, 3)), tried))
    return Moves(rows, [PassTemplate(label % 2, 10 * label, label, 1) for label in range(99)])


def edges(table: Moves) -> list[tuple[Diagram, int, Diagram, float]]:
    """Every outcome of every image: before, move and image as one number, after, chance."""
    return [
        (table.nodes[b].image(k), IMAGES * label + k, table.nodes[a].image(k), seen / tried)
        for b, label, a, seen, tried in table.rows.tolist()
        for k in range(IMAGES)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_chances_are_those_of_brute_force(seed: int) -> None:
    table, values = random_table(seed), dict[Diagram, float]()
    shown = {node: float(node.code.matches(GOAL)) for node in table.nodes}
    values = shown
    for _ in range(5):
        sums: dict[tuple[Diagram, int], float] = {}
        for before, move, after, chance in edges(table):
            sums[before, move] = sums.get((before, move), 0.0) + 0.9 * chance * values[after]
        new = shown.copy()
        for (before, _), worth in sums.items():
            new[before] = max(new[before], worth)
        values = new
    weight = 0.9 * table.seen / table.tried
    found = table.values(table.shown(GOAL, 1.0, 0.0), weight, 5)
    assert max(values.values()) == 1.0 and sum(0 < value < 1 for value in values.values()) > 10
    for node, index in table.index.items():
        assert found[index] == pytest.approx(values[node], abs=1e-12)


def test_a_kind_of_move_is_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opposite = MoveKind(
        lambda target, bead, flip, sight: (
            (bead + 50 - target if flip else bead + 50 + target) % 100
        ),
        lambda target, nx: -target,
    )
    node = Diagram(GaussCode.parse("1+a,1-a"), ())
    one = PassTemplate(len(KINDS), 130, 3, 1)
    with monkeypatch.context() as changed:
        changed.setattr(moves, "KINDS", (*KINDS, opposite))
        Moves([(node, 0, node, 1, 2)], [one]).save(tmp_path / "moves.h5")
        (read,) = Moves.load(tmp_path / "moves.h5").templates
        assert read == one and all(one.image(k, 3).image(k, 3) == one for k in range(IMAGES))
    with pytest.raises(InvalidFile, match="moves of kind 2, and KINDS here has 2"):
        Moves.load(tmp_path / "moves.h5")


def test_a_table_survives_its_file(tmp_path: Path) -> None:
    table = random_table(2)
    table.save(tmp_path / "moves.h5")
    read = Moves.load(tmp_path / "moves.h5")
    assert read.nodes == table.nodes and (read.rows == table.rows).all()
    assert read.index == table.index and (read.number == table.number).all()
    assert read.templates == table.templates[:60]  # those of the 60 moves that were made
