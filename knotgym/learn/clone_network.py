"""The clone's network: attention over the beads of a marked rope, and heads that choose.

A macro-action is chosen as bead, strand given bead, and side given both, so that a state with
several good macro-actions doesn't get a mixture of them. Another head tells whether a macro-action
works here. All is in the canonical frame of `envs.marked`.

After a change run `pytest tests/learn/test_clone.py`; weights that ship must still load, and
`knotgym evaluate --policy pretrained-clone --task tie --nx 2 --episodes 256` stay in the interval
of docs/benchmark.md.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from knotgym.learn.colour_reading import BEADS
from knotgym.learn.train_config import HEADS

# Sizes: other widths and numbers of layers are in notes/experiments.md; of these no others are on
# record.
_PATCH = 10  # neighbouring beads in one token
_VISITS = 12  # visits of a code that the network sees
_ARCS, _ARC_WIDTH = 2 * _VISITS + 1, 6
_POINT, _TANGENT = 6.0, 35.0  # per metre, scales at which inputs are of order 1
_BEAD_WIDTH = 32
_LIKELY = 8, 4  # beads, and strands for each of them, both sides of which are likely choices
# Weight of the chance that one works, beside that of being chosen. With 1, 2 and 4 an earlier clone
# reached 50.8, 53.1 and 48.8 % at tie nx 3 (notes/experiments.md).
WORKING = 3.0
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


def inputs(seen: Sequence[Any]) -> Inputs:
    """Return the network's inputs of the first four parts of `Marked`, arrays or tensors."""
    points, marks, code, goal = (torch.as_tensor(part) for part in seen)
    points, marks = points.float(), marks.float()
    # central differences: the direction of the rope at each vertex, which positions alone leave to
    # be learned
    tangents = points.roll(-1, 1) - points.roll(1, 1)
    beads = torch.cat([points * _POINT, tangents * _TANGENT, marks], dim=2)
    # Arc k begins after the k-th visit. The visits of a bead itself come after it begins, so they
    # are taken off again.
    visits = marks.sum(2)
    arcs = (visits.cumsum(1) - visits).long().clamp(max=_ARCS - 1)
    tokens = torch.stack([code, goal], dim=1)[:, :, :_VISITS].long()
    # 1 over, -1 under, 0 after the end of the code; the index of the other visit
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


class CloneNetwork(nn.Module):
    """Attention over patches of beads, and the heads for macro-actions."""

    def __init__(self, width: int, layers: int):
        super().__init__()
        # names of modules are keys of stored weights, so a rename breaks checkpoints
        self.arc = nn.Embedding(_ARCS, _ARC_WIDTH)
        codes = 2 * _VISITS * (2 + _VISITS)
        self.codes = nn.Sequential(
            nn.Linear(codes, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )
        # Ten neighbouring beads make one token, so attention is over ten patches and the code and
        # not over a hundred beads: about a hundredth of the products.
        self.inward = nn.Linear(_PATCH * (8 + _ARC_WIDTH), width)
        # learned, as the canonical frame gives bead 0 a meaning
        self.place = nn.Parameter(0.1 * torch.randn(BEADS // _PATCH, width))
        layer = nn.TransformerEncoderLayer(
            width, HEADS, 3 * width, 0.0, batch_first=True, norm_first=True
        )
        self.body = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.norm = nn.LayerNorm(width)
        beads = _BEAD_WIDTH
        self.outward = nn.Linear(width, _PATCH * beads)
        self.local = nn.Linear(8 + _ARC_WIDTH, beads)
        self.bead = nn.Linear(beads, 1)
        # The strand is pointed at: a query of the chosen bead against all beads, with a bias by
        # their distance along the rope.
        self.query = nn.Sequential(
            nn.Linear(beads + width, width), nn.ReLU(), nn.Linear(width, beads)
        )
        self.apart = nn.Embedding(BEADS, 1)
        self.side = nn.Sequential(
            nn.Linear(3 * beads + width, width), nn.ReLU(), nn.Linear(width, 4)
        )
        # no distance is preferred at first
        nn.init.zeros_(self.apart.weight)

    def signature(self) -> Tensor:
        """Return what the network makes of a marked ring, and of some macro-actions there."""
        angle = torch.arange(BEADS) * 2 * torch.pi / BEADS
        ring = 0.2 * torch.stack([angle.cos(), 0.5 * angle.sin(), 0.1 * (3 * angle).sin()], dim=1)
        marks = torch.zeros(BEADS, 2)
        marks[30, 0] = marks[70, 1] = 1
        tokens = torch.tensor([[1, 1], [-1, 0]] + [[0, -1]] * (_VISITS - 2))
        states = inputs([one[None] for one in (ring, marks, tokens, -tokens)])
        macros = torch.tensor([[[5, 40, 0], [60, 10, 1], [95, 50, 1]]])
        seen = self(states)
        parts = seen.logits[:, ::9], seen.whole[:, ::9], *self.rate(seen, macros)
        return torch.cat([part.flatten() for part in parts])

    def forward(self, states: Inputs) -> MarkedInputs:
        """Look at states."""
        count = len(states.beads)
        seen = torch.cat([states.beads, self.arc(states.arcs)], dim=2)
        # both codes as one vector: a token of its own, and added to every patch
        whole = self.codes(states.codes.flatten(1))[:, None]
        patches = self.inward(seen.reshape(count, BEADS // _PATCH, -1)) + self.place + whole
        tokens = self.norm(self.body(torch.cat([whole, patches], dim=1)))
        # back to beads: what a patch knows, and beside it what each bead has of its own
        beads = self.outward(tokens[:, 1:]).reshape(count, BEADS, -1) + self.local(seen)
        beads = functional.relu(beads)
        return MarkedInputs(beads, tokens[:, 0], self.bead(beads)[..., 0])

    def _targets(self, seen: MarkedInputs, beads: Tensor) -> Tensor:
        """Return logits (n, k, BEADS) of the strand to pass, given the bead to lead, (n, k)."""
        whole = seen.whole[:, None].expand(-1, beads.shape[1], -1)
        query = self.query(torch.cat([_picked(seen.beads, beads), whole], dim=2))
        logits = query @ seen.beads.transpose(1, 2)
        distance = (torch.arange(BEADS, device=beads.device) - beads[..., None]) % BEADS
        return logits + self.apart(distance)[..., 0]

    def _sides(self, seen: MarkedInputs, beads: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (n, k, 2) of passing under and over, and logits that either works."""
        # the product of both beads' features tells what neither alone does: how the two lie to each
        # other
        one, two = _picked(seen.beads, torch.cat([beads, targets], dim=1)).chunk(2, dim=1)
        whole = seen.whole[:, None].expand(-1, beads.shape[1], -1)
        side, works = self.side(torch.cat([one, two, one * two, whole], dim=2)).chunk(2, dim=2)
        return side, works

    def loss(self, states: Inputs, macros: Tensor, worked: Tensor) -> Tensor:
        """Return the loss (n, 4) of bead, strand and side chosen, and of what works.

        Args:
            states: n states.
            macros: int64 (n, 3), beads, strands and sides.
            worked: bool (n,), whether a macro-action works; only those that do are imitated.
        """
        seen = self(states)
        beads, targets, sides = macros.unbind(1)
        side, works = self._sides(seen, beads[:, None], targets[:, None])
        strand = self._targets(seen, beads[:, None])[:, 0]
        led, passed = _smoothed_loss(seen.logits, beads), _smoothed_loss(strand, targets)
        sided = functional.cross_entropy(side[:, 0], sides, reduction="none")
        chosen = torch.stack([led, passed, sided], dim=1)
        # choices that didn't work are imitated by nobody: they only teach the last head
        chance = worked.float()[:, None]
        working = functional.binary_cross_entropy_with_logits(
            works[:, 0].gather(1, sides[:, None]), chance, reduction="none"
        )
        return torch.cat([chance * chosen, working], dim=1)

    def likely(self, seen: MarkedInputs) -> Tensor:
        """Return macro-actions, int64 (n, 64, 3): both sides of the likeliest beads and strands."""
        some, each = _LIKELY
        beads = seen.logits.topk(some, dim=1).indices
        targets = self._targets(seen, beads).topk(each, dim=2).indices.flatten(1)
        # 8 beads, 4 strands each, 2 sides: the 64 of which `rate` finds the best
        pairs = torch.stack([beads.repeat_interleave(each, 1), targets], dim=2)
        sides = torch.arange(2).repeat(len(pairs), pairs.shape[1])[..., None]
        return torch.cat([pairs.repeat_interleave(2, 1), sides], dim=2)

    def rate(self, seen: MarkedInputs, macros: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-probabilities (n, k) that macro-actions are chosen, and that they work.

        Args:
            seen: n states.
            macros: int64 (n, k, 3): bead, strand, 0 for under or 1 for over.
        """
        beads, targets, sides = macros.unbind(2)
        chosen = functional.log_softmax(seen.logits, 1).gather(1, beads)
        strands = functional.log_softmax(self._targets(seen, beads), 2)
        side, works = self._sides(seen, beads, targets)
        # log p(bead) + log p(strand | bead) + log p(side | both)
        for logs, index in ((strands, targets), (functional.log_softmax(side, 2), sides)):
            chosen = chosen + logs.gather(2, index[..., None])[..., 0]
        return chosen, functional.logsigmoid(works.gather(2, sides[..., None])[..., 0])


def _picked(beads: Tensor, index: Tensor) -> Tensor:
    """Return the rows (n, k, width) of beads (n, BEADS, width) at an index (n, k)."""
    return beads.gather(1, index[..., None].expand(-1, -1, beads.shape[2]))


def _smoothed_loss(logits: Tensor, beads: Tensor) -> Tensor:
    """Return the cross entropy (n,) of beads (n,), with labels smoothed over their neighbours."""
    logs = functional.log_softmax(logits, dim=1)
    rows = torch.arange(len(beads), device=beads.device)
    losses = [-weight * logs[rows, (beads + off) % BEADS] for off, weight in _SMOOTHING]
    return torch.stack(losses).sum(0)
