"""A set of weighted hypotheses about the rope's shape, updated from pictures and the chain engine.

A picture hardly shows heights: a plain loop, for one, looks like its own mirror image. So the agent
keeps several candidate ropes that the picture may show. After a pull, the chain engine moves all of
them; how well the beads of each then match the next picture reweights them, as in a particle
filter.

Nor does a picture show where in the world the rope is. The camera follows the rope's middle (the
mean of its beads), and an action names a point of the world and pulls the bead nearest to it. So to
pull a bead that is visible in the picture, the agent must also know where the middle is. Each
particle of `PositionBelief` is one possible middle; observing which bead an action moved reweights
them. Lengths are in metres, z up.

After a change run `pytest tests/learn/test_shape_hypotheses.py tests/learn/test_picture_policy.py`,
and `knotgym evaluate --policy pretrained --task tie --nx 2 --episodes 256`: success must stay in
the interval of docs/benchmark.md.
"""

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, kernel
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.reader import Reader
from knotgym.rendering import draw
from knotgym.rope import ChainSimulation
from knotgym.topology import GaussCode, label_many

# Chosen without comparison. No file depends on these values: after a change `pretrained` must
# score as docs/benchmark.md says.
PARTICLES = 384
# Standard deviation around a start position met in training, metres: smooths that empirical prior.
_START_NOISE = 0.02
# Prior probability that every particle is wrong and the rope lies where ropes start.
_RESTART = 0.02
# Standard deviation added after each pull, metres. It keeps resampled particles distinct and covers
# the error of the engine's predicted motion.
_DRIFT = 0.004
# Worth of pulling the intended bead, its neighbours, and theirs: neighbours move much alike.
_NEAR = np.array([1.0, 0.7, 0.3])
# Distances beyond a bead at which `aim` tries points, metres. A point farther out on the free side
# names the bead more robustly, but also comes nearer to beads of other strands.
_MARGINS = (0.0, 0.015, 0.04, 0.12, 0.5)
REACH = 2.0  # metres for which an action's coordinate of 1 stands

# As above: chosen without comparison, and `pretrained` must score as before.
# Errors of neighbouring beads are correlated, so BEADS residuals count as BEADS / 25 independent
# ones: the log-likelihood is divided by this.
_CORRELATION = 25.0
# A prediction is given up for a new reading when redrawing it differs from the picture by this much
# more than redrawing the reading does: mean absolute difference, grey levels.
_DIVERGED = 0.5
# Hypotheses whose heights differ by less than this count as the same one: root mean square, metres.
_MERGED = 0.008
# Only this many of the most likely hypotheses decide which bead was pulled and which code is shown.
_CONSULTED = 2
# Prior probability of a pulled bead that no position particle predicts.
_SURPRISE = 0.0005
# Hypotheses kept, at most; and extra ones per pull, each a kept one with perturbed heights, with
# the standard deviation of that perturbation, metres.
_KEPT, _VARIED, _WAVE = 24, 24, 0.008
_FRESH = 0.05  # prior probability that all hypotheses are wrong and a new reading is better
_BLUR = 0.003  # standard deviation between predicted and read bead positions, metres
_READ_CODES = 30  # perturbed copies of a reading from which the codes it may stand for are counted
MOST_IMAGINED = max(BEADS, _KEPT + _VARIED)  # ropes at once


class PositionBelief:
    """Particles for the position of one rope's middle.

    Attributes:
        positions: float64 (PARTICLES, 3), metres, equally likely.
    """

    def __init__(self, starts: Array, rng: np.random.Generator) -> None:
        """Draw particles around `starts`, the start positions met in training, float64 (n, 3)."""
        self._rng = rng
        self._starts = starts
        self.positions: Array = self._draw_starts(PARTICLES)

    def aim(self, points: Array, bead: int) -> tuple[Array, float]:
        """Choose the point of the world that best names a bead.

        Args:
            points: float64 (beads, 3), the rope relative to its middle, metres.
            bead: to be pulled.

        Returns:
            The point, float64 (3,), and its expected worth in [0, 1], as `_NEAR` weighs beads.
        """
        middle = np.median(self.positions, axis=0)
        away = _directions(points, bead)
        candidates = np.concatenate([points[bead] + middle + margin * away for margin in _MARGINS])
        candidates = np.clip(candidates, -REACH, REACH)
        worth = _expected_worth(points, self.positions, candidates, bead, _NEAR)
        best = int(worth.argmax())
        return candidates[best], float(worth[best])

    def most_informative(self, points: Array) -> Array:
        """Choose a point whose pull would tell most about the position, float64 (3,).

        Which bead a named point pulls is a function of the particle, so the expected information
        gain is the entropy of the distribution over pulled beads.
        """
        some = points[self._rng.integers(len(points), size=24)]
        particles = self.positions[self._rng.integers(PARTICLES, size=24)]
        candidates = np.concatenate([some + particles, some + self.positions.mean(0)])
        distributions = [self.bead_probabilities(points, candidate) for candidate in candidates]
        entropy = [-(p[p > 0] * np.log(p[p > 0])).sum() for p in distributions]
        return candidates[int(np.argmax(entropy))]

    def bead_probabilities(self, points: Array, named: Array) -> Array:
        """Return the probability that naming a point pulls each bead, float64 (beads,)."""
        nearest = _nearest_beads(points, self.positions, named)
        return np.bincount(nearest, minlength=len(points)) / PARTICLES

    def update(self, points: Array, named: Array, likelihood: Array) -> None:
        """Reweight and resample the particles after a pull.

        Args:
            points: float64 (beads, 3), the rope before the pull, relative to its middle.
            named: float64 (3,), the point that the action named.
            likelihood: float64 (beads,), of the next picture if that bead was pulled.
        """
        # Fresh draws from the prior share the weight _RESTART, so that the filter recovers when no
        # particle explains what happened.
        positions = np.concatenate([self.positions, self._draw_starts(PARTICLES)])
        # the floor keeps weights normalizable where every likelihood underflows
        weights = likelihood[_nearest_beads(points, positions, named)] + 1e-9
        weights[:PARTICLES] *= 1 - _RESTART
        weights[PARTICLES:] *= _RESTART
        picked = self._rng.choice(len(positions), size=PARTICLES, p=weights / weights.sum())
        self.positions = positions[picked] + self._rng.normal(0, _DRIFT, (PARTICLES, 3))

    def _draw_starts(self, count: int) -> Array:
        drawn = self._starts[self._rng.integers(len(self._starts), size=count)]
        return drawn + self._rng.normal(0, _START_NOISE, (count, 3))


def _directions(points: Array, bead: int) -> Array:
    """Return unit vectors in which to look for a point that names a bead, float64 (n, 3)."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    # twelve horizontal, twelve each tilted up and down by 35 degrees, straight up and down
    tilted = np.concatenate([around + (0, 0, 0.7), around - (0, 0, 0.7), [(0, 0, 1), (0, 0, -1)]])
    # and away from the beads nearby: the side on which the bead is likely to be the nearest one
    others = points - points[bead]
    near = np.linalg.norm(others, axis=1)
    outward = -(others[near < 0.1]).mean(axis=0)[None]
    directions = np.concatenate([around, tilted, outward + 1e-9])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@kernel
def _nearest_beads(points: Array, positions: Array, named: Array) -> Ids:
    """Return, for each particle, the bead that naming a point would pull, int64 (particles,)."""
    nearest = np.empty(len(positions), np.int64)
    for k in range(len(positions)):
        # bead i lies at points[i] + positions[k]; moving the named point instead costs 3
        # subtractions per particle, not 3 per bead
        x = named[0] - positions[k, 0]
        y = named[1] - positions[k, 1]
        z = named[2] - positions[k, 2]
        best, at = np.inf, 0
        for i in range(len(points)):
            far = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if far < best:
                best, at = far, i
        nearest[k] = at
    return nearest


@kernel
def _expected_worth(
    points: Array, positions: Array, candidates: Array, bead: int, near: Array
) -> Array:
    """Average over particles how well each candidate point names a bead, float64 (candidates,)."""
    worth = np.zeros(len(candidates))
    beads = len(points)
    for t in range(len(candidates)):
        nearest = _nearest_beads(points, positions, candidates[t])
        for k in range(len(positions)):
            # distance along the closed rope, either way round
            off = abs(nearest[k] - bead)
            off = min(off, beads - off)
            if off < len(near):
                worth[t] += near[off]
    return worth / len(positions)


class ShapeHypotheses:
    """Weighted candidate ropes of one episode.

    Attributes:
        ropes: float64 (n, BEADS, 3), metres, most likely first, each centred on its middle.
        velocities: float64 (n, BEADS, 3), m/s.
        weights: float64 (n,), probabilities that sum to 1.
        position: belief about the position of the rope's middle.
        goals: candidate codes of the goal and their weights; empty before its picture is seen.
        bead: the one most likely pulled by the last action.
    """

    def __init__(
        self, reader: Reader, chain: ChainSimulation, starts: Array, rng: np.random.Generator
    ) -> None:
        """Begin an episode; `starts` are the start positions met in training, float64 (n, 3).

        `chain` has at least MOST_IMAGINED ropes.
        """
        self._reader, self._chain, self._rng = reader, chain, rng
        self.position = PositionBelief(starts, rng)
        self.ropes = self.velocities = np.zeros((1, BEADS, 3))
        self.weights = np.ones(1)
        self.goals = dict[GaussCode, float]()
        self.bead = 0

    def observe(
        self, picture: NDArray[np.uint8], named: Array | None = None, force: Array | None = None
    ) -> NDArray[np.uint8]:
        """Read a picture of rope and goal; the goal is read once.

        Args:
            picture: uint8 (SIZE, 2 SIZE, 3).
            named, force: of the action before it, see `_update`; without them the rope's readings
                are the hypotheses.

        Returns:
            The rope's half, uint8 (SIZE, SIZE, 3).
        """
        size = picture.shape[0]
        if not self.goals:
            self.goals = self.codes(np.ascontiguousarray(picture[:, size:]))
        rope = np.ascontiguousarray(picture[:, :size])
        if named is None or force is None:
            self._start(rope)
        else:
            self._update(rope, named, force)
        return rope

    def _start(self, picture: NDArray[np.uint8]) -> None:
        """Take the readings of an episode's first picture, uint8 (SIZE, SIZE, 3), as hypotheses."""
        read, weights = self._reader.read(picture)
        self._keep(read, np.zeros_like(read), weights)

    def _update(self, picture: NDArray[np.uint8], named: Array, force: Array) -> None:
        """Predict the effect of an action and reweight the hypotheses by the next picture.

        Args:
            picture: uint8 (SIZE, SIZE, 3), after the action.
            named: float64 (3,), the point of the world that the action named, metres.
            force: float64 (3,), relative to the largest.
        """
        read, read_weights = self._reader.read(picture)
        self._infer_pulled_bead(read[0], named, force)

        # Predict: every hypothesis, and copies with perturbed heights so that the set doesn't
        # collapse, are moved by the engine as the real rope was pulled.
        rows = self._rng.choice(len(self.ropes), size=_VARIED, p=self.weights)
        varied = perturb_heights(self.ropes[rows], _WAVE, self._rng)
        before = np.concatenate([self.ropes, varied])
        speeds = np.concatenate([self.velocities, self.velocities[rows]])
        beads = np.full(len(before), self.bead)
        after, velocities = imagine(self._chain, before, speeds, beads, force)

        # Reweight by Bayes' rule: prior times likelihood of the picture's reading. Kept hypotheses
        # and their perturbed copies get half of the prior each.
        middles = after.mean(axis=1)
        fit = self._log_likelihood(after - middles[:, None], read[0])
        prior = np.concatenate([self.weights, np.full(len(rows), 1 / max(1, len(rows)))])
        carried = prior * np.exp(fit - fit.max())
        best = int(np.argmax(carried))
        self.position.positions = self.position.positions + middles[best]

        # Correct each prediction by the picture. The new readings compete with them at the prior
        # _FRESH, or 1 - _FRESH if the best prediction plainly doesn't look like the picture.
        followed = self._reader.follow(picture, after - middles[:, None], after - before)
        off, read_off = _difference(followed[best], picture), _difference(read[0], picture)
        fresh = 1 - _FRESH if read_off + _DIVERGED < off else _FRESH
        self._keep(
            np.concatenate([followed, read]),
            # a reading has no velocity of its own: it takes the best prediction's
            np.concatenate([velocities, np.tile(velocities[best], (len(read), 1, 1))]),
            np.concatenate([(1 - fresh) * carried / carried.sum(), fresh * read_weights]),
        )

    def codes(self, picture: NDArray[np.uint8], current: bool = False) -> dict[GaussCode, float]:
        """Return the probabilities of the codes, without chirality, that a picture may show.

        Args:
            picture: uint8 (SIZE, SIZE, 3), of another rope, such as the goal's.
            current: it is the current picture of this rope.
        """
        ropes, weights = self.ropes[:_CONSULTED], self.weights[:_CONSULTED]
        if not current:
            ropes, weights = self._reader.read(picture)
        # A reading is about a millimetre off, enough to miss or invent a small kink. So the codes
        # of many perturbed copies are counted instead of trusting that of the reading itself.
        varied = self._reader.perturb(picture, ropes, _READ_CODES, self._rng)
        codes: dict[GaussCode, float] = {}
        for code, weight in zip(label_many(varied), np.repeat(weights, _READ_CODES), strict=True):
            codes[code.plain] = codes.get(code.plain, 0.0) + float(weight)
        total = sum(codes.values())
        return {code: weight / total for code, weight in codes.items()}

    def sample(self, count: int) -> tuple[Array, Array]:
        """Sample hypotheses with their velocities; the first is always the most likely one."""
        rows = self._rng.choice(len(self.ropes), size=count, p=self.weights)
        rows[0] = 0
        return self.ropes[rows], self.velocities[rows]

    def _infer_pulled_bead(self, read: Array, named: Array, force: Array) -> None:
        """Infer which bead the last action pulled; update the position belief by it."""
        # Pull each bead in turn in the model. log p(reading | bead) sums over the consulted
        # hypotheses, weighted: a log-sum-exp accumulated one hypothesis at a time.
        fit = np.full(BEADS, -np.inf)
        for rope, velocity, weight in zip(
            self.ropes[:_CONSULTED], self.velocities, self.weights, strict=False
        ):
            ropes, speeds = (np.tile(array, (BEADS, 1, 1)) for array in (rope, velocity))
            after, _ = imagine(self._chain, ropes, speeds, np.arange(BEADS), force)
            logs = self._log_likelihood(after - after.mean(axis=1, keepdims=True), read)
            fit = np.logaddexp(fit, logs + np.log(weight))
        likelihood = np.exp(fit - fit.max())
        prior = self.position.bead_probabilities(self.ropes[0], named)
        self.bead = int(np.argmax(likelihood * (prior + _SURPRISE)))
        self.position.update(self.ropes[0], named, likelihood)

    def _log_likelihood(self, predicted: Array, read: Array) -> Array:
        """Return log p(read | predicted) up to a constant, float64 (n,).

        Args:
            predicted: float64 (n, BEADS, 3).
            read: float64 (BEADS, 3); its heights are ignored, for a picture hardly shows them.
        """
        off = ((predicted[..., :2] - read[None, :, :2]) ** 2).sum(axis=2)
        # Gaussian, truncated at four standard deviations: a bead that was misread, being hidden
        # under another strand, must not outvote all others.
        return -np.minimum(off, (4 * _BLUR) ** 2).sum(axis=1) / (2 * _BLUR**2 * _CORRELATION)

    def _keep(self, ropes: Array, velocities: Array, weights: Array) -> None:
        """Keep the most likely hypotheses; merge those that differ little in height."""
        kept: list[int] = []
        total = weights.copy()
        for row in np.argsort(-weights, kind="stable").tolist():
            off = ropes[kept, :, 2] - ropes[row, :, 2]
            same = np.flatnonzero((off**2).mean(axis=1) < _MERGED**2)
            if len(same):
                # a duplicate adds its weight to the more likely one, even once the set is full
                total[kept[same[0]]] += weights[row]
            elif len(kept) < _KEPT:
                kept.append(row)
        kept.sort(key=lambda row: -total[row])
        self.ropes, self.velocities = ropes[kept], velocities[kept]
        self.weights = total[kept] / total[kept].sum()


def imagine(
    chain: ChainSimulation, points: Array, velocities: Array, beads: Ids, forces: Array
) -> tuple[Array, Array]:
    """Predict what one action does to ropes, by the chain engine; nothing of the episode is used.

    Args:
        chain: at least n ropes, overwritten.
        points, velocities: float64 (n, BEADS, 3), metres and m/s; left as they were.
        beads: int64 (n,), pulled.
        forces: float64 (n, 3) or (3,), in units of the largest force.

    Returns:
        Points and velocities after it.
    """
    ids = np.arange(len(points))
    chain.set_points(points, velocities, ids)
    chain.step(beads, chain.max_force * np.broadcast_to(forces, (len(ids), 3)), ids)
    return chain.points[ids], chain.velocities(ids)


def perturb_heights(ropes: Array, size: float, rng: np.random.Generator) -> Array:
    """Add one random sinusoid to the heights of each rope.

    Args:
        ropes: float64 (n, BEADS, 3), left as they were.
        size: standard deviation of the change, metres.
        rng: draws 1 to 8 waves round the loop, a phase and an amplitude per rope.
    """
    number = rng.integers(1, 9, (len(ropes), 1))
    angle = number * 2 * np.pi * np.arange(BEADS) / BEADS + rng.uniform(0, 2 * np.pi, number.shape)
    changed = ropes.copy()
    # sqrt(2) cos has unit variance over a period
    changed[..., 2] += size * rng.normal(size=number.shape) * np.sqrt(2) * np.cos(angle)
    return changed


def _difference(points: Array, picture: NDArray[np.uint8]) -> float:
    """Return the mean absolute difference of a rope's drawing and a picture, grey levels."""
    drawn = draw(points).astype(np.int16)
    return float(np.abs(drawn - picture).mean())
