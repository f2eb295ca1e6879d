"""Action views: what an agent's action is, and the pulls that carry it out; a record in VIEWS each.

    "pull"    float32 (6,): x, y, z, fx, fy, fz in [-1, 1], see `actions`; one pull
    "bead"    int (4,): the bead, and choices of fx, fy, fz, see `actions`; one pull
    "macro"   int (3,): the bead to lead, the bead whose strand it passes, and 0 for under or 1 for
              over; as many pulls as it takes
    "decision" float32 (43,) in [-1, 1]: a position, for the bead nearest to it, relative to the
              rope's centre and in units of a third of a metre; the forces of up to LONGEST pulls of
              that bead; and for each of those pulls a number, at most 0 from the first that isn't
              made any more (the first is always made)

A decision is what a macro-action came to, without looking in between. Unlike its name, it can be
averaged, perturbed and turned, so that learners of continuous actions learn it.
A macro-action is a pass without chance, carried out by the `WaypointFollower` until the
bead has reached its last waypoint, the episode has ended, or LONGEST pulls were made. A change of
code doesn't end it: a crossing that has only just been made comes undone in the next one.

A new view is a record; then the keyword `action` takes its name everywhere.
After a change run `pytest tests/envs/test_action_views.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, Ids, InvalidInput, Kinds
from knotgym.rope.actions import FORCE_CHOICES, LONGEST, NEAR, checked, nearest_beads, quantized

if TYPE_CHECKING:
    from knotgym.rope.interface import Simulation

Actions = NDArray[Any]
Pull = tuple[NDArray[np.int64], NDArray[np.floating]]
_OF_PULLS = slice(3, 3 + 3 * LONGEST)  # the forces of a decision


class Taken(NamedTuple):
    """Actions of n transitions as datasets store them.

    Attributes:
        steps: columns of steps, one row a state.
        before, after: int64 (n,), the rows in which each action begins and ends.
        name: column of the pulls in six numbers: "action", or "expert_action".
        reach: of the rope, metres.
    """

    steps: Mapping[str, NDArray[Any]]
    before: Ids
    after: Ids
    name: str
    reach: float

    @property
    def points(self) -> Array:
        """Vertices of the ropes where the actions begin, float64 (n, beads, 3), metres."""
        return self.steps["observation"][self.before].astype(np.float64)

    @property
    def beads(self) -> NDArray[np.int64]:
        """Beads that are pulled first."""
        if self.name == "action":
            return self.steps["bead"][self.before].astype(np.int64)
        positions = self.steps[self.name][self.before, :3].astype(np.float64)
        return nearest_beads(self.points, self.reach * positions)


class ViewKind(NamedTuple):
    """Everything in which one view of actions differs from the others.

    Frames are `envs.CanonicalFrames` of n ropes, symmetries `loaders.Symmetries` of n samples.

    Attributes:
        size: how many numbers an action has.
        stored: actions (n, size) of columns, in the world.
        pull: the next pull of busy ropes: beads int64 (n,); forces (n, 3), in units of the largest.
        counts: values of each whole number, 0 for as many as there are beads; () for numbers in
            [-1, 1].
        begin: prepares `view.actions` of ropes that begin an action.
        spent: which ropes have no pull left after one, bool (n,).
        is_plain: whether an action is a pull as policies choose and datasets store it.
        is_macro: whether actions are macro-actions, which are recorded as such.
        leads: whether an action is several pulls, so that a transition is what they lead to.
        relative: whether positions are about the rope's centre in every frame; models may then
            return a row for each bead.
        seen: actions (n, size) in frames, of those stored, and what else a batch has; None if no
            frame applies.
        to_world: maps checked actions from frames into the world, given vertices (n, beads, 3) and
            the rope's reach; None if no frame applies.
        image: actions (n, ..., size) after symmetries of ropes of so many beads; None if they have
            none.
        acts_as: the view of an environment in which models of this one act; "" for itself.
        says: what an action is, for errors; "" for what follows from the rest.
    """

    size: int
    stored: Callable[[Taken], Actions]
    pull: Callable[[ActionView, Ids], Pull]
    counts: tuple[int, ...] = ()
    begin: Callable[[ActionView, Ids], None] = lambda view, ids: None
    spent: Callable[[ActionView, Ids], NDArray[np.bool_]] = lambda view, ids: view._is_spent(ids)
    is_plain: bool = False
    is_macro: bool = False
    leads: bool = False
    relative: bool = False
    seen: Callable[[Any, Taken, Actions], dict[str, Actions]] | None = None
    to_world: Callable[[Any, Array, Array, float], Actions] | None = None
    image: Callable[[Any, Actions, int], Actions] | None = None
    acts_as: str = ""
    says: str = ""

    def space(self, beads: int) -> spaces.Space[Actions]:
        """Return the space of one action on a rope of so many beads."""
        if self.counts:
            return spaces.MultiDiscrete([count or beads for count in self.counts])
        return cast("spaces.Space[Actions]", spaces.Box(-1.0, 1.0, (self.size,), np.float32))


class ActionView:
    """Carries out agents' actions on the ropes of a simulation, pull by pull.

    Attributes:
        LONGEST: most pulls of a macro-action or of a decision.
        NEAR: metres from the rope's centre that 1 stands for in a decision.
        name: one of VIEWS.
        simulation: the ropes.
        counts: int64 (size,), how many values each whole number has; None if the numbers are in
            [-1, 1].
        size: how many numbers an action has.
        actions: float64 (count, size), each rope's current or last action.
        lengths: int64 (count,), pulls that it has, at most.
        busy: bool (count,), whether a rope's action has pulls left.
        pulls: int64 (count,), pulls of each rope's current or last action.
        macros: int64 (count, 3), the current or last macro-action: bead, target, side (+1 over, -1
            under).
        follower: leads the beads of macro-actions.
    """

    LONGEST: ClassVar[int] = LONGEST
    NEAR: ClassVar[float] = NEAR

    def __init__(self, view: str, simulation: Simulation) -> None:
        from knotgym.rope.macro_actions import WaypointFollower  # which needs the simulator

        self.name, self.simulation = view, simulation
        count, beads = simulation.points.shape[:2]
        self.counts: NDArray[np.int64] | None = getattr(self.kind.space(beads), "nvec", None)
        self.size = self.kind.size
        self.actions: Array = np.zeros((count, self.size))
        self.lengths = np.ones(count, dtype=np.int64)
        self.follower = WaypointFollower(count)
        self.busy = np.zeros(count, dtype=bool)
        self.pulls = np.zeros(count, dtype=np.int64)
        self.macros = np.zeros((count, 3), dtype=np.int64)

    @property
    def kind(self) -> ViewKind:
        """The record of the view."""
        return VIEWS[self.name]

    @staticmethod
    def force_choices(forces: ArrayLike) -> NDArray[np.int64]:
        """Return the nearest choice for each force component in [-1, 1], int64 of the same shape.

        >>> ActionView.force_choices([-1.0, 0.0, 0.97]).tolist()
        [0, 5, 10]
        """
        half = (FORCE_CHOICES - 1) // 2
        # choices 0 to 2 half stand for -1 to 1, the one in the middle for no force
        return np.rint(half * (1 + np.asarray(forces, dtype=np.float64))).astype(np.int64)

    @staticmethod
    def chosen_forces(chosen: ArrayLike) -> NDArray[np.float64]:
        """Return the force component, quantized, that each choice means.

        >>> ActionView.chosen_forces([0, 5, 10]).tolist()
        [-1.0, 0.0, 1.0]
        """
        half = (FORCE_CHOICES - 1) // 2
        return quantized((np.asarray(chosen, dtype=np.float64) - half) / half)

    def _is_spent(self, ids: Ids) -> NDArray[np.bool_]:
        """Return which of the ropes `ids` have made all pulls that their actions have."""
        return self.pulls[ids] >= self.lengths[ids]

    def check(self, actions: ArrayLike, ids: Ids) -> Array:
        """Return the actions of the ropes `ids` as float64 (n, size).

        Raises:
            InvalidInput: they have another shape, or a number is out of range.
        """
        what = f"an action of the view {self.name!r} is {self.size}"
        what += " numbers in [-1, 1]" if self.counts is None else " whole numbers"
        what = self.kind.says or what
        return checked(actions, (len(ids), self.size), what, self.counts)

    def reset(self, ids: Ids) -> None:
        """Drop the actions of ropes whose episodes begin."""
        self.busy[ids], self.pulls[ids] = False, 0

    def begin(self, actions: ArrayLike, ids: Ids) -> None:
        """Start actions on the ropes `ids`.

        Raises:
            InvalidInput: as in `check`; no rope's action has changed.
        """
        self.actions[ids] = self.check(actions, ids)
        self.busy[ids], self.pulls[ids] = True, 0
        self.kind.begin(self, ids)

    def pulls_of(self, ids: Ids) -> Pull:
        """Return the next pull of each of the ropes `ids`, which are busy; see `ViewKind.pull`."""
        return self.kind.pull(self, ids)

    def pulled(self, ids: Ids, ended: NDArray[np.bool_]) -> None:
        """Record that the ropes `ids` made a pull, and whether it `ended` their episodes."""
        self.pulls[ids] += 1
        self.busy[ids] = ~self.kind.spent(self, ids) & ~ended

    @staticmethod
    def image(symmetries: Any, actions: Actions, beads: int) -> Actions:
        """Return actions (n, ..., size) after symmetries; their view is found by their form.

        Raises:
            InvalidInput: they may be of several views or of none, or have no images.
        """
        size, whole = actions.shape[-1], actions.dtype.kind in "iu"
        fits = [
            name
            for name, value in VIEWS.items()
            if (value.size, bool(value.counts)) == (size, whole)
        ]
        if len(fits) != 1:
            views = f"may be of the views {', '.join(fits)}" if fits else "are of no view"
            raise InvalidInput(f"{size} numbers of an action {views}, so no image of them is known")
        kind = VIEWS[fits[0]]
        if kind.image is None:
            instead = ": load them in frame 'canonical'" if kind.seen else ""
            raise InvalidInput(f"{fits[0]}s have no images here{instead}")
        return kind.image(symmetries, actions, beads)


# six numbers


def _pull(view: ActionView, ids: Ids) -> Pull:
    return view.simulation.read_actions(view.actions[ids], ids)


def _pull_seen(frames: Any, taken: Taken, actions: Actions) -> dict[str, Actions]:
    points, turned = taken.points, actions.astype(np.float64)
    beads = nearest_beads(points, taken.reach * turned[:, :3])
    turned[:, :3] = frames.places(beads, points) / taken.reach
    turned[:, 3:] = frames.vectors(turned[:, 3:])
    return {"actions": turned.clip(-1, 1).astype(np.float32)}


def _pull_to_world(frames: Any, actions: Array, points: Array, reach: float) -> Actions:
    world, rows = actions.copy(), np.arange(len(actions))
    world[:, 3:] = frames.vectors(world[:, 3:], back=True)
    beads = nearest_beads(frames.points(points), reach * world[:, :3])
    world[:, :3] = points[rows, frames.renumber(beads, points.shape[1])] / reach
    return world.clip(-1, 1).astype(np.float32)


def _pull_image(symmetries: Any, actions: Actions, beads: int) -> Actions:
    # position and force are two vectors, moved alike
    moved: Actions = symmetries.vectors(actions.reshape(*actions.shape[:-1], 2, 3))
    return moved.reshape(actions.shape)


# a bead and binned forces


def _bead_stored(taken: Taken) -> Actions:
    forces = taken.steps[taken.name][taken.before, 3:]
    return np.column_stack([taken.beads, ActionView.force_choices(forces)])


def _bead_pull(view: ActionView, ids: Ids) -> Pull:
    forces = view.chosen_forces(view.actions[ids, 1:4])
    return view.actions[ids, 0].astype(np.int64), forces.astype(np.float32)


# a macro-action


def _macro_stored(taken: Taken) -> Actions:
    names = (f"macro_{part}" for part in ("bead", "target", "side"))
    bead, target, side = (taken.steps[name][taken.before].astype(np.int64) for name in names)
    # the side -1 and +1 is an agent's 0 and 1
    return np.stack([bead, target, (side + 1) // 2], axis=1)


def _macro_begin(view: ActionView, ids: Ids) -> None:
    view.macros[ids] = view.actions[ids] * (1, 1, 2) - (0, 0, 1)
    view.follower.begin_passes(ids, view.macros[ids], view.simulation.points)


def _macro_pull(view: ActionView, ids: Ids) -> Pull:
    points = view.simulation.points
    view.follower.arrive(points, ids)
    return view.follower.beads[ids], view.follower.forces(points, ids)


def _macro_spent(view: ActionView, ids: Ids) -> NDArray[np.bool_]:
    # waypoints that the pull reached are passed now, so that an action that is over ends with this
    # pull and not with one more
    arrived = view.follower.arrive(view.simulation.points, ids)
    return arrived | (view.pulls[ids] >= LONGEST)


def _macro_seen(frames: Any, taken: Taken, actions: Actions) -> dict[str, Actions]:
    return {"actions": frames.macros(actions, taken.points.shape[1])}


def _macro_image(symmetries: Any, actions: Actions, beads: int) -> Actions:
    made = actions.copy()
    made[..., :2] = symmetries.beads(actions[..., :2], beads)
    flips = symmetries.switch.reshape(-1, *(1 for _ in actions.shape[1:-1]))
    made[..., 2] = np.where(flips, 1 - actions[..., 2], actions[..., 2])
    return made


# a decision


def _decision_begin(view: ActionView, ids: Ids) -> None:
    chosen, points = view.actions[ids], view.simulation.points[ids]
    places = points.mean(axis=1) + NEAR * chosen[:, :3]
    view.actions[ids, 0] = nearest_beads(points, places)
    made = chosen[:, 4 + 3 * LONGEST :] > 0  # the pulls after the first
    view.lengths[ids] = 1 + made.cumprod(axis=1).sum(axis=1)


def _decision_pull(view: ActionView, ids: Ids) -> Pull:
    forces = view.actions[ids, _OF_PULLS].reshape(len(ids), LONGEST, 3)
    size = quantized(forces[np.arange(len(ids)), view.pulls[ids]])
    return view.actions[ids, 0].astype(np.int64), size.astype(np.float32)


def _decision_seen(frames: Any, taken: Taken, actions: Actions) -> dict[str, Actions]:
    """Return decisions; and their beads, and whether they hold all pulls that were made."""
    steps, before, after, points = taken.steps, taken.before, taken.after, taken.points
    each = before[:, None] + np.arange(LONGEST)
    inside = np.minimum(each, after[:, None] - 1)
    # a macro-action ends where the next begins, or before a pull that is part of none
    made = ((each < after[:, None]) & (steps["macro_side"][inside] != 0)).cumprod(axis=1) > 0
    forces = np.where(made[..., None], steps["force"][inside], 0)
    ended = before + made.sum(axis=1) == after
    return {
        "actions": frames.decisions(taken.beads, forces, np.where(made, 1, -1), points),
        "beads": frames.renumber(taken.beads, points.shape[1]),
        "whole": ended | made.all(axis=1),
    }


def _decision_to_world(frames: Any, actions: Array, points: Array, reach: float) -> Actions:
    world, rows = actions.copy(), np.arange(len(actions))
    forces = frames.vectors(world[:, _OF_PULLS].reshape(len(world), LONGEST, 3), back=True)
    world[:, _OF_PULLS] = forces.reshape(len(world), -1)
    beads = nearest_beads(frames.points(points), NEAR * world[:, :3])
    pulled = points[rows, frames.renumber(beads, points.shape[1])]
    world[:, :3] = (pulled - frames.centres) / NEAR
    return world.clip(-1, 1).astype(np.float32)


VIEWS = Kinds(
    "action",
    {
        "pull": ViewKind(
            6,
            lambda taken: taken.steps[taken.name][taken.before],
            _pull,
            is_plain=True,
            says="an action is 6 numbers in [-1, 1] (x, y, z, fx, fy, fz)",
            seen=_pull_seen,
            to_world=_pull_to_world,
            image=_pull_image,
        ),
        "bead": ViewKind(
            4, _bead_stored, _bead_pull, counts=(0, FORCE_CHOICES, FORCE_CHOICES, FORCE_CHOICES)
        ),
        "macro": ViewKind(
            3,
            _macro_stored,
            _macro_pull,
            counts=(0, 0, 2),
            begin=_macro_begin,
            spent=_macro_spent,
            is_macro=True,
            leads=True,
            seen=_macro_seen,
            to_world=lambda frames, actions, points, reach: frames.macros(actions, points.shape[1]),
            image=_macro_image,
        ),
        "decision": ViewKind(
            3 + 4 * LONGEST,
            lambda taken: taken.steps[taken.name][taken.before],
            _decision_pull,
            begin=_decision_begin,
            leads=True,
            relative=True,
            seen=_decision_seen,
            to_world=_decision_to_world,
            acts_as="pull",
        ),
    },
)
