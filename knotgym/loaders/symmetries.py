"""The task's symmetries, for batches of transitions: draw one for each sample.

    batch = transitions.batch(rows)
    batch = Symmetries.drawn(len(rows), rng).applied(batch)  # one image of each sample

Turning the rope about z, mirroring it in a vertical plane and switching over and under map motions
to motions exactly: a step of the image ends within 1e-12 m of the image of the step in the chain
engine, 1e-6 m in MuJoCo. Walking it the other way does so within 2 mm, because sub-chains meet at
other beads (`topology.symmetry`). The goal, its code and the action change with the state. An image
whose force leaves [-1, 1] is dropped: after a turn, a strong pull may have a larger component.

Observations may be vertices ("state") or codes ("symbolic"). The frame "canonical" of loaders and
environments shows all images of a state alike, and so does "marked": there is nothing to draw.

After a change run `pytest tests/loaders/test_symmetries.py`: an image of a step must be the step of
the image.
"""

from collections.abc import Mapping
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import InvalidInput
from knotgym.envs import Marked, Observer
from knotgym.rope import ActionView
from knotgym.topology import CodeArrays, Symmetry

Array = NDArray[Any]
_PAIRS = ("observations", "next_observations")  # rope and goal, unless a batch is loaded apart
_HALVES = ("goals", "negatives")
_ACTIONS = ("actions", "history", "next_history")
_SAME = frozenset(
    "rewards terminals timeouts discounts pulls action_mask history_mask next_history_mask".split()
)


class Symmetries(Symmetry):
    """A symmetry for each of n samples: the fields of `topology.symmetry.Symmetry` as arrays (n,).

    Attributes:
        turn: float64 (n,), about z, radians.
        reflect: bool (n,), x -> -x.
        switch: bool (n,), z -> -z.
        reverse: bool (n,), the vertex j becomes the vertex -j.
    """

    @classmethod
    def drawn(cls, count: int, rng: np.random.Generator, *, reverse: bool = True) -> "Symmetries":
        """Draw `count` symmetries uniformly.

        Args:
            count: number of samples.
            rng: generator of the draws.
            reverse: whether half of them walk the other way, which is a symmetry only nearly.
        """
        turn = rng.uniform(0, 2 * np.pi, count)
        flags = rng.random((3, count)) < 0.5
        return cls(turn, flags[0], flags[1], flags[2] & reverse)

    def _visits(self, visits: ArrayLike) -> NDArray[np.int16]:
        """Map codes, int16 (n, ..., SYMBOLS), as `observations.cut` gives them."""
        codes = np.asarray(visits, dtype=np.int16)
        flags = np.stack([self.switch, self.reverse], axis=1).astype(np.int16)
        ones = [1] * (codes.ndim - 2)
        flags = np.broadcast_to(flags.reshape(len(codes), *ones, 2), (*codes.shape[:-1], 2))
        rows = np.concatenate([codes, flags], axis=-1).reshape(-1, Observer.SYMBOLS + 2)
        # few different codes in a batch: each is mapped once
        different, at = np.unique(rows, axis=0, return_inverse=True)
        for row in different:
            (code,) = CodeArrays(row[None, : Observer.SYMBOLS]).objects()
            code = code.switched() if row[-2] else code
            code = code.reversed() if row[-1] else code
            row[: len(code.visits)] = code.visits
        return different[at.ravel(), : Observer.SYMBOLS].reshape(codes.shape)

    def applied(self, batch: Mapping[str, Any], beads: int = 100) -> dict[str, Any]:
        """Return one image of each of the n samples of a batch, but for those that are dropped.

        Args:
            batch: what `arrays` or `Transitions.batch` returns, of any view of the actions; one
                loaded with `apart` has `goals`.
            beads: of a rope, if actions number them and codes are observed; the number is known
                from vertices.

        Returns:
            The same arrays; without the samples in which a force would leave [-1, 1].

        Raises:
            InvalidInput: the batch has no actions or observations, has what no symmetry is known
                for, or is of another size.
        """
        made, kept = dict[str, Any](), np.ones(len(self.turn), dtype=bool)
        if missing := [name for name in ("observations", "actions") if name not in batch]:
            raise InvalidInput(f"a batch to transform has {', '.join(missing)}; this one hasn't")
        seen = batch["observations"]
        state = np.asarray(seen["state"] if isinstance(seen, dict) else seen)
        pair = 1 if "goals" in batch else 2
        beads = state.shape[-1] // (3 * pair) if state.dtype.kind == "f" else beads
        for name, values in batch.items():
            if name in _PAIRS + _HALVES:
                ropes = pair if name in _PAIRS else 1
                see = partial(self._observations, ropes=ropes, beads=beads)
                made[name] = Observer.map_parts(values, see)
            elif name in _ACTIONS:
                made[name] = ActionView.image(self, np.asarray(values), beads)
                if made[name].dtype.kind == "f":
                    forces = np.abs(made[name][..., 3:])
                    kept &= (forces <= 1 + 1e-6).all(axis=tuple(range(1, forces.ndim)))
            elif name in _SAME:
                made[name] = np.asarray(values)
            else:
                raise InvalidInput(f"no symmetry is known for {name!r} of a batch; leave it out")
        return dict(Observer.map_parts(made, itemgetter(kept)))

    def _observations(self, seen: ArrayLike, ropes: int, beads: int) -> Array:
        values = np.asarray(seen)
        if len(values) != len(self.turn):
            raise InvalidInput(f"{len(self.turn)} symmetries don't fit {len(values)} samples")
        if values.dtype == np.int16:
            return self._visits(values)
        is_state = values.dtype.kind == "f" and values.shape[-1] == 3 * ropes * beads
        # marked rows of 61 beads are as long as vertices of 69
        if not is_state or Marked.fits(values.reshape(-1, values.shape[-1])):
            raise InvalidInput(
                "observations to transform are of the kind state or symbolic; marked ones are alike"
                " for all images of a state"
            )
        points = values.reshape(*values.shape[:-1], ropes, beads, 3)
        return self.vertices(points).reshape(values.shape)
