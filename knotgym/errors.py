"""The base class of all errors this package raises on purpose, and those that rooms share."""

from typing import Any


class KnotgymError(Exception):
    """Something the caller can mend; the message is one line: what was wrong, what was given, what
    would be right.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the finished message, so that an __init__ that makes it from other things isn't
        asked again.
        """
        return type(self).__new__, (type(self), *self.args), self.__dict__


class MissingFile(KnotgymError, FileNotFoundError):
    """There is no file or folder where one should be."""
