"""The one base class of the errors this package raises on purpose."""

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
