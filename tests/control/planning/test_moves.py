import heapq
import math
from collections import defaultdict
from pathlib import Path

import h5py
import numpy as np
import pytest

from knotgym.common import InvalidFile, MissingFile
from knotgym.control.planning.moves import MoveRow, Moves, pooled
from knotgym.control.planning.sights import IMAGES, Diagram
from knotgym.topology import GaussCode, chiralities, planar_codes

CODES = [
    GaussCode(code.visits, letters)
    for nx in range(4)
    for code in planar_codes(nx)
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
            rows.append(
                MoveRow(before, label, Diagram(CODES[after]), int(rng.integers(1, 3)), tried)
            )
    return Moves(rows)


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
    found = table.values(table.shown(GOAL, 1.0, 0.0), np.zeros(len(table.start)), weight, 5)
    assert max(values.values()) == 1.0 and sum(0 < value < 1 for value in values.values()) > 10
    for node, index in table.index.items():
        assert found[index] == pytest.approx(values[node], abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_certain_moves_make_shortest_paths(seed: int) -> None:
    table = random_table(seed)
    # one outcome a move: each is tried until it succeeds
    single = Moves(
        MoveRow(table.nodes[b], n, table.nodes[a], seen, tried)
        for n, (b, _, a, seen, tried) in enumerate(table.rows.tolist())
    )
    far, leading_to = {node: math.inf for node in single.nodes}, defaultdict(list)
    for before, move, after, chance in edges(single):
        leading_to[after].append((before, move, chance))
    queue = [(0.0, n, node) for n, node in enumerate(far) if node.code.matches(GOAL)]
    while queue:
        distance, _, node = heapq.heappop(queue)
        if distance < far[node]:
            far[node] = distance
            for before, move, chance in leading_to[node]:
                heapq.heappush(queue, (distance + 1 / chance, len(far) + move, before))
    cost = single.tried / single.seen
    shown = single.shown(GOAL, 0.0, -math.inf)
    found = single.values(shown, -cost, np.ones(len(cost)), 1000)
    for node, index in single.index.items():
        assert -found[index] == pytest.approx(far[node])


def test_image_k_of_a_node_stands_k_apart_by_xor() -> None:
    table = random_table(0)
    for index, node in enumerate(table.nodes[:200]):
        for k in range(IMAGES):
            assert table.nodes[index ^ k] == node.image(k)


def test_counts_add_up_over_the_symmetries_of_a_diagram() -> None:
    loop, kink = Diagram(GaussCode(), (0,)), Diagram(GaussCode.parse("1+c,1-c"), (1, 2))

    def same(nx: int, image: int, label: int) -> int:
        return label

    rows = pooled([(loop, 3, kink, 2), (loop, 3, None, 5)], same)
    own = [k for k in range(IMAGES) if loop.image(k) == loop]
    assert len(own) > 1
    assert {row.tried for row in rows} == {7 * len(own)}
    assert sum(row.seen for row in rows) == 2 * len(own)


def test_more_rows_leave_a_table_alone() -> None:
    table = random_table(1)
    nodes, rows = len(table.nodes), len(table.rows)
    new = Diagram(GaussCode.parse("1+c,1-c,2+c,2-c,3+c,3-c,4+c,4-c"))
    more = table.extended([MoveRow(new, 99, table.nodes[0], 1, 2)])
    assert (len(table.nodes), len(table.rows)) == (nodes, rows) and new not in table.index
    assert len(more.rows) == rows + 1 and new in more.index


def test_a_table_survives_its_file(tmp_path: Path) -> None:
    table = random_table(2)
    table.save(tmp_path / "moves.h5")
    read, _ = Moves.load(tmp_path / "moves.h5")
    assert read.nodes == table.nodes and (read.rows == table.rows).all()
    assert read.index == table.index and (read.label == table.label).all()


def test_a_file_without_a_column_is_refused(tmp_path: Path) -> None:
    random_table(2).save(tmp_path / "moves.h5")
    with h5py.File(tmp_path / "moves.h5", "r+") as file:
        del file["outcomes/seen"]
    with pytest.raises(InvalidFile, match="seen"):
        Moves.load(tmp_path / "moves.h5")
    with pytest.raises(MissingFile):
        Moves.load(tmp_path / "none.h5")
