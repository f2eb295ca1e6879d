"""The clone's network: attention over the beads of a marked rope, and heads that choose.

A macro-action is chosen as bead, strand given bead, and side given both, so that a state with
several good macro-actions doesn't get a mixture of them. A pull is chosen as bead, and the choices
of its force given the bead. All is in the canonical frame of `envs.marked`.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from knotgym.envs.marked import Marked
from knotgym.learn.imagination import BEADS
from knotgym.rope.actions import FORCE_CHOICES

_PATCH = 10  # neighbouring beads in one token
_VISITS = 12  # visits of a code that the network sees
_ARCS, _ARC_WIDTH = 2 * _VISITS + 1, 6
_POINT, _TANGENT = 6.0, 35.0  # per metre, scales at which inputs are of order 1
_BEAD_WIDTH = 32
_NEIGHBOURS = 8  # beads from which the likeliest macro-action is sought
# Labels are smoothed over neighbours: a bead to either side does nearly as well.
_SMOOTHING = ((-2, 0.05), (-1, 0.15), (0, 0.6), (1, 0.15), (2, 0.05))


class Inputs(NamedTuple):
    """What the network sees of n states.

    Attributes:
        beads: float32 (n, BEADS, 8), positions, tangents and marks.
        arcs: int64 (n, BEADS), on which arc of the code each bead begins.
        codes: float32 (n, 2, _VISITS, 2 + _VISITS), the rope's and the goal's code, one-hot.
    """

    beads: Tensor
    arcs: Tensor
    codes: Tensor


def inputs(seen: Marked) -> Inputs:
    """Return the network's inputs of marked states."""
    points = torch.from_numpy(np.asarray(seen.points, dtype=np.float32))
    marks = torch.from_numpy(np.asarray(seen.marks, dtype=np.float32))
    tangents = points.roll(-1, 1) - points.roll(1, 1)
    beads = torch.cat([points * _POINT, tangents * _TANGENT, marks], dim=2)
    visits = marks.sum(2)
    arcs = (visits.cumsum(1) - visits).long().clamp(max=_ARCS - 1)
    tokens = torch.from_numpy(np.stack([seen.code, seen.goal], axis=1)[:, :, :_VISITS]).long()
    signs, partners = tokens.unbind(3)
    # an index beyond the visits that are seen, or of an empty token, has no column
    known = (partners >= 0) & (partners < _VISITS)
    onehot = functional.one_hot(partners.clamp(0, _VISITS - 1), _VISITS) * known[..., None]
    codes = torch.cat([(signs > 0)[..., None], (signs < 0)[..., None], onehot], dim=3)
    return Inputs(beads, arcs, codes.float())


class MarkedInputs(NamedTuple):
    """What the body makes of n states.

    Attributes:
        beads: (n, BEADS, _BEAD_WIDTH), of each bead.
        whole: (n, width), of the whole state.
        logits: (n, BEADS), of the bead to lead.
    """

    beads: Tensor
    whole: Tensor
    logits: Tensor


class Macros(NamedTuple):
    """Macro-actions in the canonical frame, int64 (n,) each; a side is 0 under or 1 over."""

    beads: Tensor
    targets: Tensor
    sides: Tensor


class CloneNetwork(nn.Module):
    """Attention over patches of beads; heads for macro-actions and for pulls.

    Attributes:
        noise: numbers that `choose` takes to draw one macro-action.
    """

    noise = 2 * BEADS + 2

    def __init__(self, width: int = 96, layers: int = 2, heads: int = 4, dropout: float = 0.0):
        super().__init__()
        # names of modules are keys of stored weights, so a rename breaks checkpoints
        self.arc = nn.Embedding(_ARCS, _ARC_WIDTH)
        codes = 2 * _VISITS * (2 + _VISITS)
        self.codes = nn.Sequential(
            nn.Linear(codes, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )
        self.inward = nn.Linear(_PATCH * (8 + _ARC_WIDTH), width)
        self.place = nn.Parameter(0.1 * torch.randn(BEADS // _PATCH, width))
        self.body = nn.TransformerEncoder(
            nn.TransformerEncoderLayer(
                width, heads, 3 * width, dropout, "gelu", batch_first=True, norm_first=True
            ),
            layers,
            enable_nested_tensor=False,
        )
        self.norm = nn.LayerNorm(width)
        own = _BEAD_WIDTH
        self.outward = nn.Linear(width, _PATCH * own)
        self.local = nn.Linear(8 + _ARC_WIDTH, own)
        self.bead = nn.Linear(own, 1)
        self.query = nn.Sequential(nn.Linear(own + width, width), nn.GELU(), nn.Linear(width, own))
        self.apart = nn.Embedding(BEADS, 1)
        self.side = nn.Sequential(nn.Linear(3 * own + width, width), nn.GELU(), nn.Linear(width, 2))
        self.force = nn.Sequential(
            nn.Linear(own + width, width), nn.GELU(), nn.Linear(width, 3 * FORCE_CHOICES)
        )
        nn.init.zeros_(self.apart.weight)

    def forward(self, states: Inputs) -> MarkedInputs:
        """Look at states."""
        count = len(states.beads)
        own = torch.cat([states.beads, self.arc(states.arcs)], dim=2)
        whole = self.codes(states.codes.flatten(1))[:, None]
        patches = self.inward(own.reshape(count, BEADS // _PATCH, -1)) + self.place + whole
        tokens = self.norm(self.body(torch.cat([whole, patches], dim=1)))
        beads = self.outward(tokens[:, 1:]).reshape(count, BEADS, -1) + self.local(own)
        beads = functional.gelu(beads)
        return MarkedInputs(beads, tokens[:, 0], self.bead(beads)[..., 0])

    def targets(self, seen: MarkedInputs, beads: Tensor) -> Tensor:
        """Return logits (n, BEADS) of the strand to pass, given the bead to lead."""
        rows = torch.arange(len(beads))
        query = self.query(torch.cat([seen.beads[rows, beads], seen.whole], dim=1))
        logits = (seen.beads @ query[:, :, None])[..., 0]
        apart = (torch.arange(BEADS) - beads[:, None]) % BEADS
        return logits + self.apart(apart)[..., 0]

    def sides(self, seen: MarkedInputs, beads: Tensor, targets: Tensor) -> Tensor:
        """Return logits (n, 2) of passing under and over, given the bead and the strand."""
        rows = torch.arange(len(beads))
        one, two = seen.beads[rows, beads], seen.beads[rows, targets]
        return self.side(torch.cat([one, two, one * two, seen.whole], dim=1))

    def forces(self, seen: MarkedInputs, beads: Tensor) -> Tensor:
        """Return logits (n, 3, FORCE_CHOICES) of the force, given the bead to pull."""
        one = seen.beads[torch.arange(len(beads)), beads]
        return self.force(torch.cat([one, seen.whole], dim=1)).reshape(-1, 3, FORCE_CHOICES)

    def macro_loss(self, states: Inputs, macros: Macros) -> Tensor:
        """Return the negative log-likelihood (n, 3) of bead, strand and side, smoothed."""
        seen = self(states)
        return torch.stack(
            [
                smoothed_loss(seen.logits, macros.beads),
                smoothed_loss(self.targets(seen, macros.beads), macros.targets),
                functional.cross_entropy(
                    self.sides(seen, macros.beads, macros.targets), macros.sides, reduction="none"
                ),
            ],
            dim=1,
        )

    def pull_loss(self, states: Inputs, beads: Tensor, bins: Tensor) -> Tensor:
        """Return the negative log-likelihood (n, 2) of bead and force bins (n, 3), smoothed."""
        seen = self(states)
        logits = self.forces(seen, beads)
        force = functional.cross_entropy(logits.flatten(0, 1), bins.flatten(), reduction="none")
        return torch.stack([smoothed_loss(seen.logits, beads), force.reshape(-1, 3).sum(1)], dim=1)

    def choose(self, states: Inputs, noise: Tensor, temperatures: Tensor) -> Macros:
        """Choose macro-actions: the likeliest, or drawn at a temperature.

        Args:
            states: n states.
            noise: uniform in [0, 1), (n, noise); decides what is drawn at temperatures above 0.
            temperatures: (n,); 0 for the likeliest.
        """
        seen = self(states)
        first, beads = functional.log_softmax(seen.logits, 1).topk(_NEIGHBOURS, dim=1)
        # the likeliest triple that begins with one of the likeliest beads
        many = MarkedInputs(*(column.repeat_interleave(_NEIGHBOURS, 0) for column in seen))
        second, targets = functional.log_softmax(self.targets(many, beads.flatten()), 1).max(1)
        third, sides = functional.log_softmax(self.sides(many, beads.flatten(), targets), 1).max(1)
        best = (first + (second + third).reshape(first.shape)).argmax(1)
        rows = torch.arange(len(best))
        likeliest = Macros(
            *(column.reshape(first.shape)[rows, best] for column in (beads, targets, sides))
        )
        hot = temperatures > 0
        if not hot.any():
            return likeliest
        # The maximum of logits with Gumbel noise is a draw from their softmax.
        gumbel = -torch.log(-torch.log(noise.clamp(1e-12, 1 - 1e-12)))
        scaled = (temperatures[:, None] * gumbel).float().split([BEADS, BEADS, 2], dim=1)
        bead = (seen.logits + scaled[0]).argmax(1)
        target = (self.targets(seen, bead) + scaled[1]).argmax(1)
        side = (self.sides(seen, bead, target) + scaled[2]).argmax(1)
        drawn = Macros(bead, target, side)
        return Macros(*(torch.where(hot, a, b) for a, b in zip(drawn, likeliest, strict=True)))


def smoothed_loss(logits: Tensor, beads: Tensor) -> Tensor:
    """Return the cross entropy (n,) of beads (n,), with labels smoothed over their neighbours."""
    logs = functional.log_softmax(logits, dim=1)
    rows = torch.arange(len(beads))
    losses = [-weight * logs[rows, (beads + off) % BEADS] for off, weight in _SMOOTHING]
    return torch.stack(losses).sum(0)
