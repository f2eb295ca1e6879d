"""The one base class of the errors this package raises on purpose."""


class KnotgymError(Exception):
    """Something the caller can mend; the message is one line: what was wrong, what was given, what would be right."""
