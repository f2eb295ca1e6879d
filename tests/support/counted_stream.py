"""A stream whose batches are their numbers, in a module that spawned workers can import."""

from typing import Any

from knotgym.loaders.pytorch import TorchStream


class CountedStream(TorchStream):
    """Makes nothing, so that a test of many loaders costs little."""

    def _batch_of(self, number: int) -> dict[str, Any]:
        return {"number": number}
