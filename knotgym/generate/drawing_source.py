"""States drawn from their Gauss codes.

A curve with the code is drawn (`drawing.curves`), laid in the simulator, stirred a little,
left to rest and judged. Drawings are random, so this is repeated until enough are accepted.
`WantedCodes` says which codes a run draws, and how many states of each.

After a change run `python benchmarks/golden.py --compare tests/data/golden.json`: nothing
may differ.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import count, islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym import topology
from knotgym.common import Array, Failed, InvalidInput, Stream, Table, as_json
from knotgym.drawing import drawn_curve
from knotgym.generate.generate_config import GenerateConfig
from knotgym.generate.state_rows import Selection, judge, report_of, row_of, stacked, with_report
from knotgym.quality import measure
from knotgym.rope import RopeConfig, Simulation, simulation_of
from knotgym.runs import Call, Recipe, Result
from knotgym.states import STATE_SPLITS, families
from knotgym.topology import LISTED_NX, UNKNOT, GaussCode, Knot

_RARE = 20_000  # random codes to try until one shows the knot

# The first drawings of a code must differ from all other states under every symmetry. Codes that a
# symmetry maps to each other have similar drawings, so later ones need only differ as they lie;
# `_keep_duplicates_together` then puts such states into one split.
UNLIKE_DRAWINGS = 3
# Calls at once, at least, so that few workers wait for the last one. It doesn't depend on how many
# there are, because states do depend on it.
CALLS = 4
_CODES = 4  # codes of a call, at most
_COPIES = 10  # states of a code in a call, at most
# Drawings of a call for each state, at most. It doesn't depend on `attempts`, so that a run can be
# resumed with more of them.
_DRAWINGS = 20
_ONE = np.array([0])
# Most random pulls that stir the rope laid along the curve, and the least and largest of their
# forces, relative to the largest possible; with at most 1 crossing there is but one diagram, and so
# only stirring makes states differ. Then pulls without force.
_STIR, _LOOP_STIR, _REST = (2, 0.05, 0.3), (32, 0.05, 1.0), 3


class WantedCodes:
    """The codes with one nx, by index.

    Attributes:
        listed: all codes; None if there are too many to list, and codes are drawn at random. For a
            knot whose crossing number exceeds LISTED_NX, the diagram of the knot table from every
            base point.
        existing: number of codes that show the knot; None if unknown.
        wanted: number of states to make.
        have: states that there are, by index of their code.
        given_up: codes that no more are made of.
    """

    def __init__(self, config: GenerateConfig, nx: int) -> None:
        self._knot, self._nx = Knot(config.knot), nx
        self.listed: Sequence[GaussCode] | None = None
        if config.codes:
            self.listed = [code for code in config.parsed if code.nx == nx]
        elif nx <= LISTED_NX:
            self.listed = topology.codes_of(self._knot.type, nx)
        elif nx == self._knot.diagram.nx:
            self.listed = self._knot.diagrams()
        counted = self.listed is not None and (config.codes or nx <= LISTED_NX)
        self.existing = len(self.listed or ()) if counted else None
        self._drawn: dict[GaussCode, None] = {}
        self._rng = Stream.DRAWING_CODES.generator(config.seed, nx)
        self._order: list[int] | None = None
        self.wanted, self.have, self.given_up = config.count, Counter[int](), set[int]()
        if self.listed is None:
            return
        if not self.listed:
            raise InvalidInput(f"no diagram of {config.knot} has {nx} crossings")
        order = Stream.CODE_ORDER.generator(config.seed, nx).permutation(len(self.listed))
        each = config.every_code or -(-config.count // len(self.listed))
        # first copies of all codes come before second copies
        self._order = order.tolist() * each
        if config.every_code:
            self.wanted = len(self._order)

    def _lacking(self) -> Counter[int]:
        """Count the states still to be made, by index of their code.

        A code that is given up keeps the states it has, and later codes take its other places.
        """
        chosen = Counter[int]()
        order: Iterator[int] = count() if self._order is None else iter(self._order)
        fitting = (k for k in order if k not in self.given_up or chosen[k] < self.have[k])
        # counted while `fitting` is followed, since it looks at the counts so far
        for index in islice(fitting, self.wanted):
            chosen[index] += 1
        return chosen - self.have

    def __getitem__(self, index: int) -> GaussCode:
        if self.listed is not None:
            return self.listed[index]
        while len(self._drawn) <= index:
            self._drawn.setdefault(self._next())
        return list(self._drawn)[index]

    def _next(self) -> GaussCode:
        """Draw the next random code that shows the knot."""

        for _ in range(_RARE):
            code = topology.uniform_code(self._nx, self._rng)
            if self._knot.is_shown_by(code):
                return code
        of = f"{_RARE} random codes with {self._nx} crossings"
        raise InvalidInput(f"none of {of} shows {self._knot.name}")


class _Order(NamedTuple):
    """States to draw of one code.

    Attributes:
        code: with chirality, or without for any chirality.
        which: index of the code among those of its nx.
        first: number of the first drawing.
        drawings: most drawings.
        wanted: states, at most.
        kept: float64 (n, beads, 3), states of the code that there are; none may be near them.
    """

    code: GaussCode
    which: int
    first: int
    drawings: int
    wanted: int
    kept: Array


def drawn_rows(
    config: GenerateConfig,
    report: dict[str, Any],
    apart_from: Sequence[Array] = (),
    stage: str = "drawing",
) -> Recipe[Table]:
    """Draw the states that a configuration asks for.

    Args:
        config: of source drawing.
        report: gets the run's counts.
        apart_from: points of other states, (n, beads, 3) each, which none may be near.
        stage: first words of the keys of the calls.

    Raises:
        Failed: states are missing, although all drawings have been made.
    """
    codes = {nx: WantedCodes(config, nx) for nx in config.nx}
    selection = Selection(apart_from)
    # by nx and index; `made_before`: drawings until a code's last state was kept
    made, reserved, made_before = (Counter[tuple[int, int]]() for _ in range(3))
    points_of = defaultdict[tuple[int, int], list[Array]](list)
    while needed := {
        (nx, index): lacking for nx, of in codes.items() for index, lacking in of._lacking().items()
    }:
        orders = list[_Order]()
        parts = [
            (kind, min(_COPIES, lacking - done))
            for kind, lacking in needed.items()
            for done in range(0, lacking, _COPIES)
        ]
        # later rounds are of few codes, so several calls share the drawings of each
        sharing = max(1, CALLS // len(parts)) if made else 1
        for (nx, index), wanted in (part for part in parts for _ in range(sharing)):
            # Numbers of drawings are reserved before they are made, so the same drawing never goes
            # to two calls.
            first, most = reserved[nx, index], _DRAWINGS * wanted // sharing
            there = np.array(points_of[nx, index])
            orders.append(_Order(codes[nx][index], index, first, most, wanted, there))
            reserved[nx, index] += most
        size = min(_CODES, -(-len(orders) // CALLS))
        # Keys name the drawings: with more `attempts` codes are given up later, so calls come in
        # another order.
        calls = [
            Call(f"{stage} {','.join(map(_named, some))}", _draw, (config, some))
            for some in (tuple(orders[k : k + size]) for k in range(0, len(orders), size))
        ]
        # in the order of the calls, whichever worker was done first
        for result in (yield calls):
            rows, drawn = report_of(result)
            for nx, index, drawings, reasons in drawn:
                made[nx, index] += drawings
                selection.rejected[nx].update(reasons)
            for row, seed in enumerate(rows["source/seed"]):
                nx, index, drawing = seed[2:].tolist()
                if not needed[nx, index]:
                    continue
                if selection.offer(rows, row, lenient=drawing >= UNLIKE_DRAWINGS):
                    codes[nx].have[index] += 1
                    needed[nx, index] -= 1
                    made_before[nx, index] = made[nx, index]
                    points_of[nx, index].append(rows["points"][row])
        for (nx, index), lacking in needed.items():
            if made[nx, index] - made_before[nx, index] >= config.attempts * lacking > 0:
                codes[nx].given_up.add(index)
    report.update(
        existing_codes={str(nx): of.existing for nx, of in codes.items()},
        attempts=made.total(),
        rejected=selection.reasons(config.nx),
        passed_over={
            str(nx): [str(of[index]) for index in sorted(of.given_up)] for nx, of in codes.items()
        },
    )
    missing = {nx: of.wanted - of.have.total() for nx, of in codes.items()}
    if any(missing.values()):
        listed = ", ".join(f"{count} with nx = {nx}" for nx, count in missing.items() if count)
        raise Failed(f"missing states: {listed}; give --resume with a larger --set attempts=N")
    rows = selection.rows()
    nx, which = rows["nx"].tolist(), rows["source/seed"][:, 3].tolist()
    order = sorted(range(len(nx)), key=lambda row: (config.nx.index(nx[row]), which[row]))
    return rows.take(np.array(order))


def splits_of(config: GenerateConfig, rows: Table) -> NDArray[np.str_]:
    """Assign rows to train and test; near duplicates stay together."""
    codes = [GaussCode.parse(text) for text in rows["gauss_code_chiral"].tolist()]
    assigned = np.full(len(codes), STATE_SPLITS[0], dtype="<U5")
    for nx in config.nx:
        rows_of_nx = np.flatnonzero(rows["nx"] == nx)
        rng = Stream.SPLIT.generator(config.seed, nx)
        assigned[rows_of_nx] = _split([codes[row] for row in rows_of_nx], config.train_share, rng)
    return _keep_duplicates_together(assigned, rows["points"], codes)


def _split(
    codes: Sequence[GaussCode], train_share: float, rng: np.random.Generator
) -> NDArray[np.str_]:
    """Assign states to "train" and "test", splitting the states of each code as evenly as possible.

    Args:
        codes: codes of the states, compared without chirality.
        train_share: fraction of the states that go to train.
        rng: generator of all random choices.

    Returns:
        str (n,), the split of each state.
    """
    plain = [code.plain for code in codes]
    kinds = sorted(set(plain), key=lambda code: code.visits)
    order = rng.permutation(len(kinds))
    assigned = np.full(len(codes), "test", dtype="<U5")
    # Order all states code by code, with codes and the states of each code shuffled. State i goes
    # to train where floor(i * share + 1/2) steps up: every stretch is split in the same proportion.
    groups = ([i for i, code in enumerate(plain) if code == kinds[k]] for k in order)
    walk = [index for some in groups for index in rng.permutation(some)]
    trained_by = np.floor(np.arange(len(walk) + 1) * train_share + 0.5)
    assigned[np.array(walk, dtype=np.int64)[np.diff(trained_by) > 0]] = "train"
    return assigned


def _keep_duplicates_together(
    assigned: NDArray[np.str_], points: Array, codes: Sequence[GaussCode]
) -> NDArray[np.str_]:
    """Give near-duplicates one split, and keep the sizes of splits where that is possible.

    Families of near-duplicates are assigned first, the largest first, each to the split with the
    most room for it. Of the other states those move that their own split has no room for.

    Args:
        assigned: str (n,), the split of each state.
        points: float64 (n, beads, 3), metres.
        codes: of the states; sizes are kept for each number of crossings.
    """
    changed, family = assigned.copy(), families(points)
    nx = [code.nx for code in codes]
    # room: states that each split of each nx may still take
    room = Counter(zip(nx, assigned.tolist(), strict=True))
    members = [np.flatnonzero(family == number).tolist() for number in np.unique(family)]
    for rows in sorted(members, key=len, reverse=True):  # stable: equal sizes stay in order
        split = str(assigned[rows[0]])
        names = sorted(set(assigned.tolist()), key=lambda name: name != split)  # own wins a tie
        enough = len(assigned) if len(rows) > 1 else 1
        fitting = {name: sum(min(room[nx[row], name], enough) for row in rows) for name in names}
        changed[rows] = max(names, key=lambda name: fitting[name])
        room.subtract((nx[row], str(changed[row])) for row in rows)
    return changed


def _named(order: _Order) -> str:
    return f"{order.code.nx}:{order.which}:{order.first}"


def _draw(config: GenerateConfig, orders: Sequence[_Order]) -> Result:
    """Draw codes until enough states of each are accepted.

    Returns:
        The rows, and as report a list with an entry for each order: its nx and index, the number of
        drawings, and reason -> number of rejected ones.
    """
    simulation = simulation_of(1, RopeConfig.of(config.beads), config.engine_used)
    rows, drawn = list[dict[str, Any]](), []
    for order in orders:
        selection, number = Selection([order.kept]), order.first
        rejected = selection.rejected[order.code.nx]
        while number < order.first + order.drawings and len(selection) < order.wanted:
            row = _drawn(config, order, number, simulation)
            number += 1
            if isinstance(row, list):
                rejected.update(row)
            elif selection.offer(stacked([row]), 0):
                rows.append(row)
        drawn.append([order.code.nx, order.which, number - order.first, rejected])
    return with_report(rows, drawn)


@lru_cache(maxsize=4096)
def _letters(code: GaussCode, knot: str) -> tuple[str, ...]:
    """Return the chiralities with which a code shows the knot."""
    if code.chirality is not None:
        return (code.chirality,)
    patterns = topology.chiralities(code)
    if (of := Knot(knot)).type == UNKNOT:
        return patterns
    return tuple(letters for letters in patterns if of.is_shown_by(GaussCode(code.visits, letters)))


def _drawn(
    config: GenerateConfig, order: _Order, number: int, simulation: Simulation
) -> dict[str, Any] | list[str]:
    """Make one state; if it is rejected, return the reasons."""
    letters = _letters(order.code, config.knot)
    # `which` keeps codes from all starting with the same chirality
    code = GaussCode(order.code.visits, letters[(order.which + number) % len(letters)])
    rope = simulation.rope
    seed = Stream.DRAWING.key(config.seed, code.nx, order.which, number)
    rng = Stream.generator_of(seed)
    try:
        # all chance comes from the key of (seed, code, number): the same drawing on any machine
        curve = drawn_curve(code, rng, rope, config.drawing)
    except Failed:
        return ["too tight"]
    # most rejections are seen on the curve, before anything is simulated
    if faults := config.limits.faults(measure(curve, quick=True), code.nx):
        return faults
    start = rope.qpos(curve)
    simulation.set_qpos(start[None], _ONE)
    actions = _stirred(simulation, code, rng)
    if actions is None:
        return ["simulation failed"]
    qpos = simulation.qpos(_ONE)[0]
    # where a reset lays the rope, not where the engine left it
    points = rope.points(qpos)
    judgement = judge(points, [config.limits], code=code)
    made = {"start_qpos": start, "actions": actions, "steps": len(actions), "seed": np.array(seed)}
    settings = {"policy": "drawing", "drawing": json.dumps(as_json(config.drawing))}
    return judgement.faults or row_of(judgement, points, qpos, **made, **settings)


def _stirred(
    simulation: Simulation, code: GaussCode, rng: np.random.Generator
) -> NDArray[np.float32] | None:
    """Stir rope 0 with random pulls and let it rest.

    Returns:
        The actions, float32 (T, 6); None if the simulation fails.
    """
    most, weakest, strongest = _LOOP_STIR if code.nx < 2 else _STIR
    actions = []
    for step in range((steps := int(rng.integers(most + 1))) + _REST):
        strength = rng.uniform(weakest, strongest) if step < steps else 0.0
        heading, bead = rng.uniform(-np.pi, np.pi), rng.integers(len(simulation.points[0]), size=1)
        pull = strength * np.array([[np.cos(heading), np.sin(heading), 0.0]])
        action = simulation.actions(bead, pull, _ONE)
        if not simulation.act(action, _ONE).all():
            return None
        actions.append(action[0])
    return np.array(actions)
