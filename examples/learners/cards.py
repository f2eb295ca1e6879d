"""What an entry of the board claims of a training, alike for all learners of this folder."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from knotgym.common import sha256
from knotgym.datasets import columns_of


def card_of(
    learner: str, datasets: Sequence[str], seconds: float, words: Sequence[str], **more: Any
) -> dict[str, Any]:
    """Return the card of a training.

    Args:
        learner: how it is called.
        datasets: ids or folders of what it learned from.
        seconds: of CPU that it took.
        words: of its command, from the script's file on.
        more: other claims.
    """
    opened = [columns_of(one) for one in datasets]
    script, *rest = words
    return {
        "learner": learner,
        "data": {part.name: sha256(part.path) for one in opened for part in one.parts or [one]},
        **more,
        "seconds": round(seconds, 1),
        "command": shlex.join(["python", f"examples/learners/{Path(script).name}", *rest]),
    }
