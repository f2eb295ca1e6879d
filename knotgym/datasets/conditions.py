"""Conditions on the columns of a dataset, in SQL: `nx = 3 and success and length < 30`.

polars evaluates them on a table of the columns and nothing else: a condition that contains a query,
by which SQL could read files, is refused before it is parsed.
"""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, MissingExtra, one_line

_LONGEST = 2000  # characters
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")
_QUERY = re.compile(r"\b(select|from)\b", re.IGNORECASE)


def matching_rows(text: str, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return which rows fulfil a condition: bool (n,).

    Args:
        text: the condition.
        columns: name -> one value per row: truth values, numbers or text. A column with a dot in
            its name, such as quality.clearance, may be named by its last word if that is unique.

    Raises:
        InvalidInput: the text is no condition, names no column, or divides by zero; the message is
            one line.
        MissingExtra: polars isn't installed.
    """
    try:
        import polars
    except ModuleNotFoundError as error:
        raise MissingExtra("polars", "select", "a condition") from error
    words = [name.rpartition(".")[2] for name in columns]
    short = {w: c for w, c in zip(words, columns.values(), strict=True) if words.count(w) == 1}
    named = {**columns, **{word: c for word, c in short.items() if word not in columns}}
    frame = polars.DataFrame(named, nan_to_null=True)
    if len(text) > _LONGEST or _QUERY.search(_QUOTED.sub("", text)):
        raise _refused(text, f"it must be a condition of up to {_LONGEST} characters, not a query")
    try:
        condition = polars.sql_expr(text)
        _require_sensible(text, condition, frame)
        found = frame.select(condition).to_series()
    except polars.exceptions.ColumnNotFoundError as error:
        raise _refused(text, f"columns are {', '.join(columns)}") from error
    except polars.exceptions.PolarsError as error:
        raise _refused(text, str(error).split("\n")[0]) from error
    if found.dtype != polars.Boolean or len(found) != len(frame):
        raise _refused(text, f"it gives {found.dtype}, and should be true or false for each row")
    return np.asarray(found.fill_null(False).to_numpy(), dtype=bool)


def _require_sensible(text: str, expression: Any, frame: Any) -> None:
    """Refuse parts that give no number where their inputs do, and truth values beside numbers."""
    import polars

    inputs = expression.meta.pop()
    valid = np.ones(len(frame), dtype=bool)
    kinds = set()
    for one in inputs:
        _require_sensible(text, one, frame)
        values = frame.select(one).to_series()
        if values.dtype in (polars.Float64, polars.Float32) and len(values) == len(frame):
            valid &= values.is_finite().fill_null(False).to_numpy()
        kinds.add("number" if values.dtype.is_numeric() else str(values.dtype))
    if {"number", "Boolean"} <= kinds:
        raise _refused(text, "a truth value and a number are compared; join two conditions by and")
    found = frame.select(expression).to_series()
    if inputs and found.dtype.is_numeric():
        defined = found.is_not_null() & (found.is_finite() if found.dtype.is_float() else True)
        if (~defined.to_numpy() & (valid if len(found) == len(frame) else True)).any():
            raise _refused(text, f"{expression} divides by zero, or has no value, in some row")


def _refused(text: str, why: str) -> InvalidInput:
    return InvalidInput(one_line(f"not a condition, {text[:200]!r}: {why}"))
