"""PD and DT codes: diagrams as SnapPy, spherogram, KnotTheory and KnotInfo write them.

Walking from the base point, the visits are numbered 1 to 2 n. Edge k leads to visit k, so the base
point lies on edge 1.

A PD (planar diagram) code has X[a, b, c, d] for each crossing, here in order of labels: the lower
strand comes in along edge a and leaves along c; b and d are the edges of the upper strand.

           c                            c
           |                            |
    d ---- | ---> b              d <--- | ---- b        a, b, c, d are counterclockwise
           |                            |
           a   positive                 a   negative

It has the same information as a Gauss code with chirality. The four kinks differ (X[1,1,2,2],
X[1,2,2,1], X[2,1,1,2] and X[2,2,1,1]), so every code comes back as it was.

A DT (Dowker-Thistlethwaite) code pairs the two visits of each crossing, of which one is odd and one
even in every planar diagram. It lists the even partners of 1, 3, 5, ..., negative if the even visit
is the upper one. It has the same information as a Gauss code without chirality, so handedness is
lost, separately for each summand (`diagrams.summands`): the granny knot and the square knot share
their DT codes.

The plain loop is written [] in both, as by spherogram; KnotInfo leaves it blank, and KnotTheory's
PD[Loop[1]] can be read too.

After a change run `pytest tests/topology/test_notation.py`: every code of up to four crossings must
come back, and spherogram and SnapPy read the same knot.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain

from knotgym.common import InvalidInput
from knotgym.topology.diagrams import is_planar
from knotgym.topology.gauss import GaussCode, RopesCode, invalid_code, split_visits

MOST_CROSSINGS = 1000  # of a code that is read
_MOST_CHARACTERS = 30 * MOST_CROSSINGS
_SIZE = f"codes of up to {MOST_CROSSINGS} crossings can be read"
_TEXT_OF_LOOPS = ("[]", "PD[]", "PD[Loop[1]]", "DT[]", "DT:[]", "DTCode[]", "GaussCode[]")
_NUMBER = r"-?\d{1,9}"
_LIST = rf"{_NUMBER}(?:,{_NUMBER})*"
_CROSSING = r"X?[\[(]\d{1,9}(?:,\d{1,9}){3}[\])]"
_LETTERS = {"+": "c", "-": "a"}
_BRACKETS = {ord("{"): "[", ord("}"): "]"}  # as KnotInfo writes lists
_PD = re.compile(rf"(?:PD)?[\[(](?:,?{_CROSSING})+,?[\])]|(?:,?{_CROSSING})+")
_OVER_UNDER = re.compile(r"([OoUu])(\d{1,9})([+-]?)")


def pd_code(code: GaussCode | RopesCode) -> list[list[int]]:
    """Return [a, b, c, d] for each crossing, in order of labels; see the module for the convention.

    Raises:
        InvalidInput: the code has no chirality; or a curve without crossings is open or beside
            others, for a PD code can't show it.

    >>> pd_code(GaussCode.parse("1-c,2+c,3-c,1+c,2-c,3+c"))
    [[1, 5, 2, 4], [5, 3, 6, 2], [3, 1, 4, 6]]
    """
    ropes = code if isinstance(code, RopesCode) else RopesCode.of(code)
    if len(ropes.visits) + (not ropes.closed[0]) > 1 and not all(ropes.visits):
        problem, expected = "a curve passes no crossing", "in a PD code every curve passes one"
        raise invalid_code(problem, str(ropes), expected, "PD")
    passed: dict[int, tuple[int, int]] = {}  # visit -> the edges that lead to it and away
    edge = 1
    for walk, closed in zip(ropes.visits, ropes.closed, strict=True):
        first = edge
        for visit in walk:
            passed[visit] = edge, edge + 1
            edge += 1
        if closed and walk:  # an open curve has an edge behind its last visit
            passed[walk[-1]] = edge - 1, first
        edge += not closed
    signs = GaussCode.trusted(tuple(passed), code.chirality).signs
    crossings = []
    for label, sign in enumerate(signs, 1):
        below, onwards = passed[-label]
        # at a positive crossing the upper strand runs from d to b, seen from the lower strand from
        # left to right
        d, b = passed[label] if sign > 0 else passed[label][::-1]
        crossings.append([below, b, onwards, d])
    return crossings


def pd_text(code: GaussCode | RopesCode) -> str:
    """Return the PD code as KnotInfo and JSON write it.

    >>> pd_text(GaussCode.parse("1+c,1-c"))
    '[[2,2,1,1]]'
    """
    return json.dumps(pd_code(code), separators=(",", ":"))


def dt_text(code: GaussCode) -> str:
    """Return the DT code as KnotInfo and JSON write it: the even partners of the visits 1, 3, 5,
    ..., negative where the even one is over.

    Args:
        code: a planar code; chirality is ignored.

    >>> dt_text(GaussCode.parse("1+,2-,3+,1-,4+,3-,2+,4-"))  # the figure-eight knot
    '[4, 6, 8, 2]'
    """
    # In a planar diagram the two visits of a crossing have an even number of visits between them,
    # see `diagrams.uniform_code`, so one is odd and one even.
    number = {visit: number for number, visit in enumerate(code.visits, 1)}
    return str([number[-visit] * (1 if visit > 0 else -1) for visit in code.visits[::2]])


def _from_pd(crossings: Sequence[Sequence[int]]) -> GaussCode:
    """Return the Gauss code, with chirality, of a PD code.

    Raises:
        InvalidInput: it isn't the PD code of a planar diagram of one oriented knot.

    >>> _from_pd([[1, 1, 2, 2]]).chiral
    '1-c,1+c'
    """
    if not crossings:
        return GaussCode()
    ropes = _ropes_from_pd(crossings, least=2)
    if len(ropes.visits) > 1:
        expected = "expected a knot, not a link of several components"
        raise invalid_code(f"it shows {len(ropes.visits)} curves", crossings, expected, "PD")
    return _planar(GaussCode(ropes.visits[0], ropes.chirality), crossings, "PD")


def _ropes_from_pd(crossings: Sequence[Sequence[int]], least: int = 1) -> RopesCode:
    """Return the code, with chirality, of the PD code of several curves; open ones end at the edges
    that occur once. Curves come in order of their lowest edges.

    Args:
        crossings: one or more, four edges each, in any order. Edges may have any numbers, such as
            spherogram's from 0; a closed curve begins on its lowest edge.
        least: 2 if there may be no ends.

    Raises:
        InvalidInput: an edge occurs too often or not often enough, or a lower strand is walked
            backwards.

    >>> str(_ropes_from_pd([[2, 2, 3, 1]]))  # edges 1 and 3 occur once
    '1+,1-'
    """
    ends: dict[int, list[tuple[int, int]]] = {}  # edge -> the crossings and corners that it joins
    for crossing, corners in enumerate(crossings):
        for corner, edge in enumerate(corners):
            ends.setdefault(edge, []).append((crossing, corner))
    for edge, joined in ends.items():
        if not least <= len(joined) <= 2:
            expected = "every edge joins two corners, so it occurs twice"
            raise invalid_code(f"edge {edge} occurs {len(joined)} times", crossings, expected, "PD")

    visits, closed, seen, letters = (
        list[tuple[int, ...]](),
        list[bool](),
        set[int](),
        dict[int, str](),
    )
    for edge in sorted(ends):
        if edge in seen:
            continue
        walk, shut = _followed(crossings, ends, ends[edge][0])
        if not shut:  # from an end on
            walk, _ = _followed(crossings, ends, _backwards(walk)[0])
        walk = _oriented(walk, crossings, shut)
        # an upper strand that comes in at d runs to b, as the drawing of a positive crossing has it
        letters |= {k + 1: "c" if corner == 3 else "a" for k, corner in walk if corner}
        seen |= {crossings[k][corner] for k, corner in (*walk, *_backwards(walk))}
        visits.append(tuple([(k + 1) * (1 if corner else -1) for k, corner in walk]))
        closed.append(shut)
    code = GaussCode.relabelled(chain(*visits), letters)
    return RopesCode(split_visits(code.visits, [*map(len, visits)]), tuple(closed), code.chirality)


_Walk = list[tuple[int, int]]  # crossings and the corners at which they are reached


def _followed(
    crossings: Sequence[Sequence[int]], ends: dict[int, _Walk], start: tuple[int, int]
) -> tuple[_Walk, bool]:
    """Follow a curve from where it reaches a crossing; also return whether it closes.

    Corners are a 0, b 1, c 2, d 3. A walk reaches one and leaves at the opposite one.
    """
    walk, visit = _Walk(), start
    while True:
        walk.append(visit)
        leaves = visit[0], (visit[1] + 2) % 4
        edge = ends[crossings[leaves[0]][leaves[1]]]
        onwards = [corner for corner in edge if corner != leaves]
        if not onwards or onwards[0] == start:
            return walk, bool(onwards)
        visit = onwards[0]


def _backwards(walk: _Walk) -> _Walk:
    return [(crossing, (corner + 2) % 4) for crossing, corner in reversed(walk)]


def _oriented(walk: _Walk, crossings: Sequence[Sequence[int]], shut: bool) -> _Walk:
    """Walk a curve as its lower strands say, and otherwise as its edges are numbered.

    Raises:
        InvalidInput: its lower strands contradict each other.
    """

    def _edges(walk: _Walk) -> list[int]:
        return [crossings[crossing][corner] for crossing, corner in walk]

    below = [corner for _, corner in walk if corner in (0, 2)]
    if shut:  # from the lowest edge on, whatever the numbers are
        start = _edges(walk).index(min(_edges(walk)))
        walk = walk[start:] + walk[:start]
    back = _backwards(walk)
    if shut:
        back = back[-1:] + back[:-1]
        start = _edges(back).index(min(_edges(back)))
        back = back[start:] + back[:start]
    if below[:1] == [2] or (not below and _edges(back)[:2] < _edges(walk)[:2]):
        walk = back
    if backwards := [crossing for crossing, corner in walk if corner == 2]:
        problem = f"the lower strand of crossing {backwards[0] + 1} is walked backwards"
        expected = "the first edge of each crossing is where the lower strand comes in"
        raise invalid_code(problem, crossings, expected, "PD")
    return walk


def _from_dt(partners: Sequence[int]) -> GaussCode:
    """Return the Gauss code of a DT code; its chirality is unknown, because DT doesn't have it.

    Raises:
        InvalidInput: it isn't the DT code of a planar diagram of one knot.

    >>> str(_from_dt([4, 6, 2]))
    '1+,2-,3+,1-,2+,3-'
    """
    even = sorted(map(abs, partners))
    if even != [*range(2, 2 * len(partners) + 1, 2)]:
        problem = f"it doesn't pair {len(partners)} odd visits with as many even ones"
        expected = f"expected the even numbers from 2 to {2 * len(partners)}, once each, signed"
        raise invalid_code(problem, partners, expected, "DT")
    visits = [0] * (2 * len(partners))
    for label, partner in enumerate(partners, 1):
        # a negative partner is the upper one, so the odd visit is under there
        odd_over = partner > 0
        visits[2 * label - 2] = label if odd_over else -label
        visits[abs(partner) - 1] = -label if odd_over else label
    return _planar(GaussCode.relabelled(visits), partners, "DT")


def _parse_code(text: str) -> GaussCode:
    """Read a Gauss, PD or DT code in any of the notations of `_READERS`.

    Raises:
        InvalidInput: the text is none of them, or has more than `MOST_CROSSINGS` crossings.

    >>> {str(_parse_code(text)) for text in ("1+,1-", "1 -1", "[2]", "PD[X[2,2,1,1]]")}
    {'1+,1-'}
    """
    if len(text) > _MOST_CHARACTERS:
        raise invalid_code(f"{len(text)} characters are too long", text, _SIZE, "Gauss, PD or DT")
    text = text.strip().rstrip(";")
    tight = text.translate(_BRACKETS)
    # Spaces beside punctuation mean nothing; those that are left part numbers, as commas do.
    tight = re.sub(r"\s*([\[\](),:])\s*", r"\1", tight)
    tight = re.sub(r"\s+", ",", tight)
    # a list that was cut off may be that of another code
    is_whole = all(tight.count(start) <= tight.count(end) for start, end in ("[]", "()"))
    for pattern, read in _READERS if is_whole else ():
        if pattern.fullmatch(tight) and (code := read(tight, text)) is not None:
            return code
    for pattern, name, expected in _FOREIGN:
        if pattern.fullmatch(tight):
            raise invalid_code(f"{name} isn't read", text, expected, "Gauss, PD or DT")
    if tight[:1] in ("[", "(", "P", "D", "X"):
        raise invalid_code(
            "it can't be read", text, "expected [[1,5,2,4],...] or [4,6,2]", "PD or DT"
        )
    return _sized(GaussCode.parse(text))


def parse_codes(lines: Iterable[str]) -> Iterator[GaussCode]:
    """Read the codes of a list or text, one a line; "#" begins a comment.

    Raises:
        InvalidInput: as `_parse_code`, with the number of the line.

    >>> [code.nx for code in parse_codes(["1+,1-", "4 6 2 # DT", "", "PD[X[1,1,2,2]];"])]
    [1, 3, 1]
    """
    lines = lines.splitlines() if isinstance(lines, str) else lines
    for number, line in enumerate(lines, 1):
        if text := line.partition("#")[0].strip():
            with InvalidInput.instead(f"line {number}", InvalidInput):
                yield _parse_code(text)


def parse_ropes(text: str, closed: bool | Sequence[bool] = True) -> RopesCode:
    """Read the code of several curves, or of open ones: our notation, a PD code, or O1U2;U1O2.

    Args:
        closed: whether each curve is closed, or all are; a PD code says so itself.

    Raises:
        InvalidInput: it can't be read, is too large, or a DT code, which has no ends.

    >>> [str(parse_ropes(text)) for text in ("O1U2;U1O2", "X[2,3,1,4],X[4,1,3,2]")]
    ['1+,2-;1-,2+', '1+,2-;2+,1-']
    """
    tight = re.sub(r"\s+", "", text.strip().rstrip(";").translate(_BRACKETS))
    if len(text) > _MOST_CHARACTERS:
        raise invalid_code(f"{len(text)} characters are too long", text, _SIZE)
    if _PD.fullmatch(tight):
        numbers = _numbers(tight)
        return _ropes_from_pd([numbers[k : k + 4] for k in range(0, len(numbers), 4)])
    if tight[:1] in ("[", "(", "D", "P", "X"):
        expected = "expected 1+,2-;1-,2+ or O1U2;U1O2 or a PD code; a DT code has no ends"
        raise invalid_code("it can't be read", text, expected)
    if tight[:1] in ("O", "o", "U", "u"):
        tight = _OVER_UNDER.sub(
            lambda match: (
                f"{match[2]}{'+' if match[1] in 'Oo' else '-'}{_LETTERS.get(match[3], '')},"
            ),
            tight,
        )
    return RopesCode.parse(tight.replace(",;", ";").rstrip(","), closed)


def _numbers(text: str) -> list[int]:
    return [int(number) for number in re.findall(_NUMBER, text)]


def _read_crossings(tight: str, _: str) -> GaussCode | None:
    numbers = _numbers(tight)
    # four different numbers are a DT code as SnapPy writes it: [(4,6,8,2)]
    if len(numbers) == 4 and "X" not in tight and len(set(numbers)) == 4:
        return None
    return _from_pd([numbers[k : k + 4] for k in range(0, len(numbers), 4)])


def _read_numbers(tight: str, text: str) -> GaussCode:
    numbers = _numbers(tight)
    # each label occurs with both signs in a Gauss code, with one in a DT code
    if len({*numbers}) < len(numbers):
        expected = "give the Gauss, PD or DT code of its closure"
        raise invalid_code("numbers repeat, as in a braid's word", text, expected, "Gauss or DT")
    if len(numbers) < 2 or sorted(numbers) != sorted(-number for number in numbers):
        return _from_dt(numbers)
    if "{" in text:
        expected = "write KnotInfo:{...} for KnotInfo's, where + is under, or [...] for + over"
        raise invalid_code("whose signs they are isn't said", text, expected)
    return _from_signed(numbers)


# Each row: a notation without spaces, and its reader, which may say None to leave it to later rows.
_READERS: tuple[tuple[re.Pattern[str], Callable[[str, str], GaussCode | None]], ...] = tuple(
    (re.compile(pattern, flags), read)
    for pattern, flags, read in (
        ("|".join(map(re.escape, _TEXT_OF_LOOPS)), 0, lambda *_: GaussCode()),
        # KnotInfo's Gauss code by its name, as there + is under
        (rf"KnotInfo:?\[?{_LIST},?\]?", re.IGNORECASE,
         lambda tight, _: _from_signed([-number for number in _numbers(tight)])),
        # KnotTheory's, where + is over
        (rf"GaussCode\[{_LIST}\]", 0, lambda tight, _: _from_signed(_numbers(tight))),
        # O1-U2-O3-U1-O2-U3- or O1U2O3U1O2U3
        (r"[OoUu].*", re.DOTALL, lambda _, text: _from_over_under(text)),
        # PD codes of KnotInfo, with outer brackets or without, of KnotTheory and of Python
        (_PD.pattern, 0, _read_crossings),
        # DT codes of KnotInfo, also bare numbers, of KnotTheory and of SnapPy; signed numbers
        (rf"(?:DT(?:Code)?:?)?[\[(]*{_LIST}[\])]*", 0, _read_numbers)
    )
)  # fmt: skip


# What others write that isn't read, without spaces: its name, and what to write instead.
_FOREIGN = tuple(
    (re.compile(pattern), name, expected)
    for pattern, name, expected in (
        (rf"(?:BR(?:aid)?)?[\[(]\d+,[\[(](?:{_LIST})?[\])][\])]|BR(?:aid)?\W.*", "a braid's word",
         "give the Gauss, PD or DT code of its closure"),
        (rf"(?:Link|Knot)?[\[(]*{_LIST}\](?:,\[{_LIST}\])*\],\[-?1(?:,-?1)*\][\])]+",
         "Sage's oriented Gauss code", "give its pd_code()"),
        (r"(?:Knot|Link|K|L)?[\[(]?\d+[an]?_\d+[\])]?|(?:Knot|Link)\[.*|[KL]\d+[an]\d+",
         "a knot's name", "give a Gauss, PD or DT code, such as KnotInfo's"),
    )
)  # fmt: skip


def _from_signed(numbers: list[int]) -> GaussCode:
    """Return the Gauss code of signed numbers, + over."""
    return _planar(GaussCode.relabelled(numbers), numbers)


def _from_over_under(text: str) -> GaussCode:
    """Return the Gauss code of visits such as O1 or U2-; "-" between visits may only part them."""
    visits = _OVER_UNDER.findall(text)
    if re.sub(r"[\s,;-]", "", _OVER_UNDER.sub("", text)):
        raise invalid_code("it can't be read", text, "expected such as O1-U2-O3-U1-O2-U3-")
    # "-" may only part visits, as in O1-U2-O3; where the last visit has a sign, too, it is a sign
    signed = bool(visits) and all(sign for _, _, sign in visits)
    if "+" in [sign for _, _, sign in visits] and not signed:
        expected = "give every visit its crossing's sign"
        raise invalid_code("only some visits have a sign", text, expected)
    letters: dict[int, str] = {}
    for _, number, sign in visits if signed else ():
        if letters.setdefault(int(number), _LETTERS[sign]) != _LETTERS[sign]:
            problem, expected = f"crossing {number} has two signs", "both visits have the same sign"
            raise invalid_code(problem, text, expected)
    numbers = [int(number) if over in "Oo" else -int(number) for over, number, _ in visits]
    return _planar(GaussCode.relabelled(numbers, letters or None), text)


def _planar(code: GaussCode, given: object, kind: str = "Gauss") -> GaussCode:
    """Return a code that was read, if it isn't too large, and some closed curve shows it."""
    if _sized(code) and is_planar(code):
        return code
    expected = "expected the code of a curve drawn in the plane"
    raise invalid_code("no planar diagram has it", given, expected, kind)


def _sized(code: GaussCode) -> GaussCode:
    if code.nx > MOST_CROSSINGS:
        what = "Gauss, PD or DT"
        raise invalid_code("it is too large", f"{code.nx} crossings", _SIZE, what)
    return code
