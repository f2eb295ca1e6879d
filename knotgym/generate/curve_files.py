"""Files of closed curves, read in the forms in which others publish them.

    .csv .tsv .txt .dat .xyz   rows x y z or name x y z; the first may name the columns, then among
                               others; a line such as `t 0` before the rows is passed over
    .npy                       array (n, 3)

A first row with the number of rows, a first column that counts them, and a last row that repeats
the first are recognized in each. Several curves in one file have names of their own, in the first
column. Components without them, such as parts between empty rows, are those of a link, which is
refused.
"""

import codecs
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from knotgym.common import Array, InvalidInput, one_line, require_regular

_MOST = 1_000_000  # lines or points of a file, characters of a line
_MOST_CURVES = 20_000  # of a file
_MEGABYTES = 64  # of a file
_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)")  # Fortran's, as in 1.5D+00
_TIME = re.compile(r"\s*(?:t|time|timestep|step|frame)\s*[=:]?\s*[-+.\deE]+\s*", re.IGNORECASE)
_COMMENT = re.compile(r"(?:^|\s)#.*")  # 3_1#4_1 is a name
Components = Iterator[tuple[str, ArrayLike]]  # a name, "" without, and points (n, 3)


class Curve(NamedTuple):
    """A closed curve, float64 (n, 3) in any unit, and where it was read.

    The last point is joined to the first. In a file that says that the curve is closed, the first
    is also the last.
    """

    name: str
    points: Array


def read_curves(path: str | Path) -> list[Curve]:
    """Read the closed curves in a file.

    Raises:
        MissingFile: there is no such file.
        InvalidInput: it can't be read, is too large, or holds a link.
    """
    given = Path(path)
    if given.suffix.lower() not in _FORMS:
        raise InvalidInput(f"curves are read from {', '.join(_FORMS)}, got {given.name!r}")
    require_regular(given, "file of curves", InvalidInput)
    if given.stat().st_size > 1_000_000 * _MEGABYTES:
        raise InvalidInput(f"{path} has more than {_MEGABYTES} MB")
    try:
        read = _FORMS[given.suffix.lower()](given)
        named = [(name, _array(points)) for name, points in read]
    except Exception as error:  # there is no end to what foreign bytes make NumPy raise
        raise InvalidInput(f"{path} can't be read as curves: {one_line(error)[:300]}") from error
    # Parts of one name are components of one link. Without names all parts are those of one link.
    for name, count in Counter(name for name, _ in named).most_common(1):
        if count > 1:
            raise InvalidInput(
                f"{path} holds a link, {count} components{f' of {name[:80]}' * bool(name)}, and a"
                " knot has one; curves of their own need different names"
            )
    if not 0 < len(named) <= _MOST_CURVES:
        many = f"{len(named)} curves, more than {_MOST_CURVES}" if named else "no curves"
        raise InvalidInput(f"{path} holds {many}")
    file, alone = given.name, len(named) == 1
    return [Curve(file if alone else f"{file}:{name[:80]}", points) for name, points in named]


def _array(points: ArrayLike) -> Array:
    values = np.asarray(points)
    if values.dtype.kind not in "fiu":
        raise InvalidInput("a curve consists of real numbers")
    if values.size > 4 * _MOST or values.shape[:1] > (_MOST,):
        raise InvalidInput(f"a curve has more than {_MOST} points")
    points = values.astype(np.float64)
    if points.ndim == 2 and points.shape[1] == 4 and _counts_rows(points[:, 0], points[:, 1:]):
        points = points[:, 1:]
    if len(points) > 3 and points.ndim == 2 and (np.diff(points[:, 0]) == 1).all():
        raise InvalidInput("its first column counts the rows, and beside it x y z are needed")
    return points


def _counts_rows(numbers: Array, points: Array) -> bool:
    """Tell whether numbers count rows: whole and rising, but in a last row that repeats the first.

    Args:
        numbers: float64 (n,).
        points: float64 (n, 3), of the same rows.
    """
    if len(points) > 1 and numbers[-1] == numbers[0] and (points[-1] == points[0]).all():
        numbers = numbers[:-1]
    return bool((numbers % 1 == 0).all() and (np.diff(numbers) > 0).all())


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text, whatever byte-order mark it begins with."""
    with open(path, "rb") as file:
        # Windows writes UTF-16 with a byte-order mark; all else is UTF-8, which may have one, too.
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    with open(path, encoding="utf-16" if wide else "utf-8-sig") as text:
        for number in range(_MOST + 1):
            line = text.readline(_MOST)
            if not line:
                return
            if number == _MOST or len(line) == _MOST:
                raise InvalidInput(f"it has more than {_MOST} lines, or characters in a line")
            yield line


def _from_table(path: Path) -> Components:
    """Read rows x y z or name x y z, parted by commas, semicolons, tabs or spaces.

    A first row that names the columns may name others, too, which aren't read.
    """
    component: list[tuple[str, list[float]]] = []
    head, columns = list[str](), list[int]()
    announced, begun, counted = "", False, False  # counted: the last line told how many rows follow
    for number, line in enumerate(chain(_lines(path), [""]), 1):
        words = _words(line)
        is_row = len(words) in (3, 4) and _numbers(words[-3:])
        if counted and not is_row:  # chemists' files have a comment there
            counted = False
        elif words[0].isdecimal() and len(words) == 1:
            yield from _by_name(component, announced, path)
            component, announced, counted = [], words[0], True
        elif any(words) and not _TIME.fullmatch(line):
            if begun or not {"x", "y", "z"} <= {*map(str.lower, words)}:
                is_whole = len(words) == len(head)
                if len(words) < len(head):
                    raise InvalidInput(f"line {number} has {len(words)} of {len(head)} columns")
                component.append(_row([words[k] for k in columns] if is_whole else words, number))
            else:
                head = [*map(str.lower, words)]
                columns = [0] * (head[0] not in (*"xyzt", "time")) + [*map(head.index, "xyz")]
            begun, counted = True, False
        elif not line.lstrip().startswith("#"):
            yield from _by_name(component, announced, path)
            component, announced = [], ""


def _words(line: str) -> list[str]:
    text = _COMMENT.sub("", line).strip()
    # the first of these that the row has; None parts by any white space
    parted_by = next((mark for mark in ",;\t" if mark in text), None)
    return [word.strip(" \t\"'") for word in text.split(parted_by)] or [""]


def _numbers(words: Sequence[str]) -> list[float]:
    """Return the numbers that words are, if all are."""
    try:
        return [*map(_number, words)]
    except ValueError:
        return []


def _number(word: str) -> float:
    return float(_EXPONENT.sub("e", word))


def _row(words: Sequence[str], number: int) -> tuple[str, list[float]]:
    if len(words) not in (3, 4):
        raise InvalidInput(f"line {number} has {len(words)} values, should be x y z or name x y z")
    with InvalidInput.instead(f"line {number}", ValueError):
        return "".join(words[:-3]), [*map(_number, words[-3:])]


def _by_name(rows: list[tuple[str, list[float]]], announced: str, path: Path) -> Components:
    """Part the rows of a component by name, unless the names only count them.

    Args:
        rows: names, "" without, and points.
        announced: the number of points that the file states; "" if it states none.
        path: in chemists' files names are those of atoms.
    """
    if announced and len(rows) != int(announced):
        raise InvalidInput(f"{announced} rows are announced, and there are {len(rows)}")
    # A first column that only counts the rows, as pandas writes, is no name.
    counts = np.array(_numbers([name for name, _ in rows]))
    if not (counts % 1 == 0).all():
        raise InvalidInput(f"rows are x y z or name x y z, and {rows[0][0]!r} is no name")
    counting = len(counts) > 0 and _counts_rows(counts, np.array([point for _, point in rows]))
    if counting or announced and path.suffix.lower() == ".xyz":
        rows = [("", point) for _, point in rows]
    for name, same in groupby(rows, itemgetter(0)):
        yield name, [point for _, point in same]


def _from_numpy(path: Path) -> Components:
    loaded = np.load(path, allow_pickle=False)
    yield from (("", points) for points in (loaded if loaded.ndim == 3 else [loaded]))


_FORMS = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".xyz"), _from_table),
    ".npy": _from_numpy,
}
