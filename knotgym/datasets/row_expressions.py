"""Conditions on the columns of a dataset, such as `nx == 3 and success and length < 30`.

    condition   comparisons, columns of truth values, `and`, `or`, `not`, True, False
    comparison  ==  !=  <  <=  >  >=  (may be chained);  in, not in  a list, or text within text
    number      columns, 12, 0.5, + - * / // %
    text        columns, "3_1"

A column may be named without its group if that is unique: clearance for quality.clearance. Text is
parsed by Python's own parser, but only the nodes listed here are interpreted, by this module;
nothing is evaluated as Python.
"""

import ast
import operator
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput

_LONGEST = 2000  # characters
_ARITHMETIC: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.true_divide,
    ast.FloorDiv: np.floor_divide,
    ast.Mod: np.mod,
}
_ORDER: dict[type, Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_KINDS = {"b": "condition", "i": "number", "u": "number", "f": "number", "U": "text"}


class _Value(NamedTuple):
    """An array of one entry per row, or a scalar, of kind "condition", "number" or "text"."""

    kind: str
    values: NDArray[Any]
    source: str


def matching_rows(text: str, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return which rows fulfil a condition.

    Args:
        text: the condition.
        columns: name -> one value per row: truth values, numbers or text.

    Raises:
        InvalidInput: the text is no condition, or names no column; the message is one line.

    >>> matching_rows("nx in (1, 3) and knot != '3_1'",
    ...     {"nx": np.array([1, 2, 3]), "knot": np.array(["0_1", "0_1", "3_1"])}).tolist()
    [True, False, False]
    """
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of Python's parser about doubtful code
            if len(text) > _LONGEST:
                raise InvalidInput(f"it has {len(text)} characters, at most {_LONGEST} may be")
            found = _evaluate(ast.parse(text.strip(), mode="eval").body, columns)
    except InvalidInput as error:
        raise InvalidInput(f"{_shown(text)} can't be used: {error}") from error
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InvalidInput(
            f"{_shown(text)} can't be read; expected such as 'nx == 3 and length < 30'"
        ) from error
    if found.kind != "condition":
        raise InvalidInput(
            f"{_shown(text)} is a {found.kind}, not a condition; compare it, such as with =="
        )
    rows = len(next(iter(columns.values()))) if columns else 0
    return np.broadcast_to(found.values, rows).copy()


def _evaluate(node: ast.expr, columns: Mapping[str, NDArray[Any]]) -> _Value:
    """Evaluate one node of the grammar.

    Raises:
        InvalidInput: the node isn't part of the grammar, or its operands are of other kinds.
    """
    source = _shown(ast.unparse(node))
    match node:
        case ast.Constant(value=bool() | int() | float() | str() as value):
            return _constant(value, source)
        case ast.Name() | ast.Attribute():
            values = columns[_column_name(ast.unparse(node), columns)]
            return _Value(_KINDS[values.dtype.kind], values, source)
        case ast.BoolOp(op=op, values=operands):
            parts = [_expect(_evaluate(one, columns), "condition") for one in operands]
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            out = parts[0]
            for part in parts[1:]:
                out = join(out, part)
            return _Value("condition", out, source)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return _Value("condition", ~_expect(_evaluate(operand, columns), "condition"), source)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return _Value("number", -_expect(_evaluate(operand, columns), "number"), source)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
            sides = [_expect(_evaluate(one, columns), "number") for one in (left, right)]
            return _Value("number", np.asarray(_ARITHMETIC[type(op)](*sides)), source)
        case ast.Compare(left=left, ops=ops, comparators=comparators):
            out = np.array(True)
            for order, right in zip(ops, comparators, strict=True):
                out = out & _compared(left, order, right, columns)
                left = right
            return _Value("condition", out, source)
    raise InvalidInput(f"{source} is not part of the grammar")


def _compared(
    left: ast.expr, op: ast.cmpop, right: ast.expr, columns: Mapping[str, NDArray[Any]]
) -> NDArray[np.bool_]:
    own = _evaluate(left, columns)
    if isinstance(op, ast.In | ast.NotIn):
        if isinstance(right, ast.Tuple | ast.List | ast.Set):
            members = [_expect(_evaluate(one, columns), own.kind) for one in right.elts]
            found = np.zeros(own.values.shape, dtype=bool)
            for member in members:
                found = found | (own.values == member)
        else:  # text within text
            within = _expect(_evaluate(right, columns), "text")
            found = np.char.find(within, _expect(own, "text")) >= 0
        return found if isinstance(op, ast.In) else ~found
    if type(op) not in _ORDER:
        raise InvalidInput(f"{type(op).__name__.lower()!r} is not part of the grammar")
    other = _evaluate(right, columns)
    if own.kind != other.kind:
        raise InvalidInput(
            f"{own.source} is a {own.kind} and {other.source} is a {other.kind}; both must be of"
            " one kind"
        )
    return np.asarray(_ORDER[type(op)](own.values, other.values))


def _constant(value: bool | int | float | str, source: str) -> _Value:
    if isinstance(value, str):
        return _Value("text", np.array(value), source)
    if isinstance(value, bool):
        return _Value("condition", np.array(value), source)
    if not abs(value) < 2**63:  # no column holds a larger one
        raise InvalidInput(f"{source} is too large")
    return _Value("number", np.array(value), source)


def _expect(found: _Value, kind: str) -> NDArray[Any]:
    if found.kind != kind:
        raise InvalidInput(f"{found.source} is a {found.kind}, should be a {kind}")
    return found.values


def _column_name(name: str, columns: Mapping[str, Any]) -> str:
    """Return the full name of a column, which may be given without its group."""
    if name in columns:
        return name
    full = [one for one in columns if one.rpartition(".")[2] == name]
    if len(full) > 1:
        raise InvalidInput(f"{name} may be {' or '.join(full)}; give one of them")
    if not full:
        raise InvalidInput(f"no column {_shown(name)}; columns are {', '.join(columns)}")
    return full[0]


def _shown(text: str) -> str:
    """Return a text that is quoted in an error: one short line."""
    line = repr(text)
    return line if len(line) <= 60 else f"{line[:57]}..."
