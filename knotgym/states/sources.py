"""Where states come from, a record for each source; and the names of their splits.

`knotgym generate` makes states by the record of their source, cards describe it, and `verify`
checks by it what led to a row. Commands and files may name no other source.
"""

from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any, NamedTuple

from knotgym.common import InvalidInput, Stream
from knotgym.rope import CHAIN, MUJOCO, EngineName
from knotgym.topology import GaussCode, Symmetry, canonical

STATE_SPLITS = ("train", "test")
# parts of "train" and "test" without a common diagram, see `States.rows`
CODE_SPLITS = ("train-code", "test-code")
# splits of pictures: test-code has held-out codes, test-nx a held-out crossing number
IMAGE_SPLITS = (*STATE_SPLITS, "test-code", "test-nx")


class Source(NamedTuple):
    """A source of states.

    Attributes:
        doc: what states of it are; a sentence or more for cards, in Markdown.
        stream: of the keys that its rows have as seeds; None if their seeds are no keys.
        rows: recipe that makes its rows, or "module:function" of it: (GenerateConfig, report to
            fill, points of states that none may be near) -> Recipe[Table]; None if
            `knotgym generate` doesn't make them.
        splits: rule that assigns rows to splits, or "module:function" of it: (GenerateConfig,
            Table) -> str (n,).
        engine: that moves the ropes unless another is asked for.
        from_ropes: whether its states are frames of pulled ropes, so that no code, knot or length
            of the rope can be asked for.
        draws_actions: whether the actions that lead to a row are `rope.drawn_actions` of its seed,
            and so aren't stored.
    """

    doc: str
    stream: Stream | None = None
    rows: Callable[..., Any] | str | None = None
    splits: Callable[..., Any] | str | None = None
    engine: EngineName = MUJOCO
    from_ropes: bool = False
    draws_actions: bool = False

    def function(self, which: str) -> Callable[..., Any]:
        """Return `rows` or `splits`, imported if it is named."""
        found: Any = getattr(self, which)
        assert found is not None  # GenerateConfig refuses sources that have none
        return resolve_name(found) if isinstance(found, str) else found


_ROPES = "All frames of a rope are in one split."
_PLAYED = "knotgym.generate.play_source:"
_DRAWN = "knotgym.generate.drawing_source:"


class _Sources(dict[str, Source]):
    """Value of `source/policy` -> record; InvalidInput for any other."""

    def __missing__(self, name: str) -> Source:
        raise InvalidInput(f"source must be one of {', '.join(self)}, got {name!r}")


SOURCES = _Sources(
    {
        "drawing": Source(
            "drawn from its code. The drawing is made again from the row's seed, laid in the"
            " simulator, stirred and left to rest by the row's actions.",
            Stream.DRAWING,
            f"{_DRAWN}drawn_rows",
            f"{_DRAWN}splits_of",
        ),
        "play": Source(
            "a frame of a rope that random and scripted policies pulled, if it is readable, not"
            f" over-twisted and new. The row's actions lead from its start to its state. {_ROPES}",
            Stream.PLAYED_ROPE,
            f"{_PLAYED}rows_of_ropes",
            f"{_PLAYED}splits_of",
            engine=CHAIN,
            from_ropes=True,
        ),
        "random-walk": Source(
            "a state as uniform random actions reach it, not selected to be easier to read; only"
            " over-twisted ones are left out. The actions of a row are drawn from its random"
            f" stream. {_ROPES}",
            Stream.RANDOM_WALK,
            f"{_PLAYED}rows_of_ropes",
            f"{_PLAYED}splits_of",
            from_ropes=True,
            draws_actions=True,
        ),
        "import": Source("a curve of a file, laid and left to rest.", Stream.IMPORT),
        # of sets that the package includes
        "demonstrations": Source(
            "met in play; the row's actions lead from a plain loop to its state."
        ),
        "bench-play": Source("met in play, laid from its vertices."),
        "bench-drawing": Source("drawn from its code, laid from its vertices."),
    }
)


def held_form(code: str, *, marked: bool) -> str:
    """Return what a split of pictures by code compares, in place of a Gauss code.

    Args:
        code: without chirality.
        marked: whether all pictures mark base and direction. If not, a picture fits every code of
            its diagram, so these are one: `topology.canonical`, which also takes mirror images
            and switched crossings for the same.
    """
    return code if marked else str(canonical(GaussCode.parse(code), Symmetry.DIAGRAM))
