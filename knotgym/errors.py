"""The base class of all errors this package raises on purpose, and those that rooms share."""

from typing import Any


class KnotgymError(Exception):
    """Something the caller can mend.

    The message is one line: what was wrong, what was given, what would be right.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the finished message: an __init__ that makes it isn't asked again."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class MissingFile(KnotgymError, FileNotFoundError):
    """There is no such file or dataset."""


class MissingExtra(KnotgymError, ImportError):
    """An optional dependency isn't installed."""

    def __init__(self, needed: str, how: str) -> None:
        super().__init__(f"this needs {needed}, which isn't installed; install it: {how}")


def one_line(error: BaseException) -> str:
    """What an error says, its line breaks taken out."""
    return " ".join(str(error).split())
