"""Frozen configurations: their numbers checked, and brought back from JSON.

A run writes its whole configuration into its manifest with `dataclasses.asdict`; JSON turns tuples
into lists and nested configurations into objects, and `from_json` turns them back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from numbers import Integral
from typing import Any, TypeVar, get_type_hints

from knotgym.errors import KnotgymError

_Config = TypeVar("_Config")


class InvalidConfig(KnotgymError, ValueError):
    """A configuration that nothing can be made with."""


def check_numbers(
    config: object,
    *,
    counts: Sequence[str] = (),
    whole: Sequence[str] = (),
    positive: Sequence[str] = (),
    non_negative: Sequence[str] = (),
    shares: Sequence[str] = (),
    ranges: Sequence[str] = (),
    error: type[KnotgymError] = InvalidConfig,
) -> None:
    """Refuse a configuration whose numbers make no sense; NaN and infinity never do.

    Args:
        config: a dataclass, whose fields the other arguments name.
        counts: whole numbers of at least 1.
        whole: whole numbers of at least 0.
        positive: above 0.
        non_negative: at least 0.
        shares: in [0, 1].
        ranges: pairs (least, most) of numbers of at least 0.
        error: what is raised.
    """
    least_whole = {**dict.fromkeys(counts, 1), **dict.fromkeys(whole, 0)}
    for name, least in least_whole.items():
        value = getattr(config, name)
        if not isinstance(value, Integral) or value < least:
            raise error(f"{name} must be a whole number of at least {least}, got {value!r}")
    for names, fits, right in (
        (positive, lambda value: 0 < value < math.inf, "above 0 and finite"),
        (non_negative, lambda value: 0 <= value < math.inf, "at least 0 and finite"),
        (shares, lambda value: 0 <= value <= 1, "in [0, 1]"),
        (ranges, _is_range, "two finite numbers, at least 0, the smaller one first"),
    ):
        for name in names:
            value = getattr(config, name)
            if not fits(value):
                raise error(f"{name} must be {right}, got {value!r}")


def from_json(kind: type[_Config], values: Mapping[str, Any]) -> _Config:
    """Make a configuration of class `kind` again from what JSON made of it.

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Walk:
    ...     force: tuple[float, float] = (0.3, 1.0)
    >>> from_json(Walk, {"force": [0.5, 1.0]})
    Walk(force=(0.5, 1.0))

    Raises:
        InvalidConfig: a value belongs to no field.
    """
    hints = get_type_hints(kind)
    if unknown := sorted(set(values) - set(hints)):
        raise InvalidConfig(f"{kind.__name__} has no {', '.join(unknown)}")
    return kind(**{name: _restored(hints[name], value) for name, value in values.items()})


def _restored(hint: Any, value: Any) -> Any:
    if is_dataclass(hint) and isinstance(hint, type) and isinstance(value, Mapping):
        return from_json(hint, value)
    return _tuples(value)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _is_range(value: Any) -> bool:
    return len(value) == 2 and 0 <= value[0] <= value[1] < math.inf
