"""The linear system of a substep: a symmetric banded matrix with an arrow, factored in place.

The unknowns of a rope of n vertices are grouped in n blocks of four, block k holding the velocity
of vertex k (x, y, z) and the spin of bead k, which begins there. A joint couples three vertices, so
block k is coupled with blocks k + 1 and k + 2, round the loop. The loop is cut at vertex 0, whose
joint must not be damped: the velocity of vertex 0 leaves block 0 and becomes the last unknown, the
*corner*; what couples it with the others is the *arrow*: the drawing is in `layout`.

The factorization is A = L D L^T without pivoting, which is stable as A is positive definite. No
block is filled in but the arrow. `factor` replaces diag[k] by the inverse pivots and the unit lower
triangle, and near, far and arrow by their blocks of L: about 330 multiplications a vertex. `fma`
rounds once on every processor, so results don't depend on how a compiler contracts products.

All arrays end with an axis of LANES ropes, see `simd`.

After a change run `pytest -m 'thorough or not thorough' tests/rope/chain/test_chain_equations.py`.
"""

from typing import Any

from knotgym.common import Array, inner
from knotgym.rope.chain.simd import fma, load, put

System = tuple[Array, Array, Array, Array]  # diag, near, far, arrow
Row = tuple[Any, Any, Any, Any]  # lanes
Pivot = tuple[Any, ...]  # 10 lanes: a packed lower triangle with inverse pivots on its diagonal


@inner
def factor(system: System) -> None:
    """Factor in place, right-looking: each column, once done, is subtracted from what follows.

    Write S = l d l^T for the pivot block of column k, and M, M' for blocks below it. The rows
    y = M l^-T and z = y d^-1 give M S^-1 M'^T = y z'^T, which is subtracted from the block that
    has M's rows and the columns of M'; z is the block of L.
    """
    diag, near, far, arrow = system
    n = len(near)  # block n of the diagonal is the corner
    for k in range(n):
        # What column k takes from later blocks is subtracted at once, so every block is complete
        # when its own turn comes, and nothing is kept but the blocks themselves.
        pivot = _pivot(diag, k)
        if k + 1 < n:
            for r in range(4):
                y = _divide(near, k, r, pivot)
                # N_k against itself changes D_(k + 1).
                # only the lower triangle of the symmetric D_(k + 1): rows of z up to r are done
                for c in range(r + 1):
                    _subtract(diag, k + 1, r * (r + 1) // 2 + c, y, near, k, c)
        if k + 2 < n:
            for r in range(3):
                # F_k has three rows, as the spin of bead k + 2 is coupled with nothing of block k.
                # Against itself it changes D_(k + 2), against N_k the block N_(k + 1) between the
                # two.
                y = _divide(far, k, r, pivot)
                for c in range(r + 1):
                    _subtract(diag, k + 2, r * (r + 1) // 2 + c, y, far, k, c)
                for c in range(4):
                    _subtract(near, k + 1, 4 * r + c, y, near, k, c)
        for r in range(3):
            # The arrow's rows are the corner's: against themselves they change the corner, against
            # N_k and F_k the arrow of the next two columns. This is all the fill-in there is.
            y = _divide(arrow, k, r, pivot)
            for c in range(r + 1):
                _subtract(diag, n, r * (r + 1) // 2 + c, y, arrow, k, c)
            if k + 1 < n:
                for c in range(4):
                    _subtract(arrow, k + 1, 4 * r + c, y, near, k, c)
            if k + 2 < n:
                # F_k has no row of spin, so the arrow's fourth column of k + 2 stays as it is
                for c in range(3):
                    _subtract(arrow, k + 2, 4 * r + c, y, far, k, c)
    # what is left in the corner is its Schur complement, 3 x 3
    # no square roots: pivots are inverted once, so that substitution multiplies
    d0 = 1.0 / load(diag, (n, 0))
    a10, a20 = load(diag, (n, 1)), load(diag, (n, 3))
    l10, l20 = a10 * d0, a20 * d0
    d1 = 1.0 / fma(-a10, l10, load(diag, (n, 2)))
    a21 = fma(-a20, l10, load(diag, (n, 4)))
    l21 = a21 * d1
    d2 = 1.0 / fma(-a21, l21, fma(-a20, l20, load(diag, (n, 5))))
    put(diag, (n, 0), d0)
    put(diag, (n, 1), l10)
    put(diag, (n, 2), d1)
    put(diag, (n, 3), l20)
    put(diag, (n, 4), l21)
    put(diag, (n, 5), d2)


@inner
def _pivot(diag: Array, k: int) -> Pivot:
    """Factor block k in place: l_ij below the diagonal, inverse pivots d on it; return it."""
    # Written out row by row. Once column j is done, a_ij = l_ij p_j stands in the block, p_j being
    # its pivot, and p_i = a_ii - sum of a_ij l_ij over the columns j before i. The names d are
    # inverse pivots, 1 / p.
    d0 = 1.0 / load(diag, (k, 0))
    a10, a20, a30 = load(diag, (k, 1)), load(diag, (k, 3)), load(diag, (k, 6))
    l10, l20, l30 = a10 * d0, a20 * d0, a30 * d0
    d1 = 1.0 / fma(-a10, l10, load(diag, (k, 2)))
    a21, a31 = fma(-a20, l10, load(diag, (k, 4))), fma(-a30, l10, load(diag, (k, 7)))
    l21, l31 = a21 * d1, a31 * d1
    d2 = 1.0 / fma(-a21, l21, fma(-a20, l20, load(diag, (k, 5))))
    a32 = fma(-a31, l21, fma(-a30, l20, load(diag, (k, 8))))
    l32 = a32 * d2
    d3 = 1.0 / fma(-a32, l32, fma(-a31, l31, fma(-a30, l30, load(diag, (k, 9)))))
    # by rows of the lower triangle, as `diag` is packed: element (i, j) is i (i + 1) / 2 + j
    pivot = (d0, l10, d1, l20, l21, d2, l30, l31, l32, d3)
    for item in range(10):
        put(diag, (k, item), pivot[item])
    return pivot


@inner
def _divide(block: Array, k: int, r: int, pivot: Pivot) -> Row:
    """Replace row r of a block below pivot k by its row of L, z = y d^-1; return y."""
    d0, l10, d1, l20, l21, d2, l30, l31, l32, d3 = pivot
    # Forward substitution along the row, y l^T = m; each y_i takes the earlier ones in their order.
    y0 = load(block, (k, 4 * r))
    y1 = fma(-l10, y0, load(block, (k, 4 * r + 1)))
    y2 = fma(-l21, y1, fma(-l20, y0, load(block, (k, 4 * r + 2))))
    y3 = fma(-l32, y2, fma(-l31, y1, fma(-l30, y0, load(block, (k, 4 * r + 3)))))
    put(block, (k, 4 * r), y0 * d0)
    put(block, (k, 4 * r + 1), y1 * d1)
    put(block, (k, 4 * r + 2), y2 * d2)
    put(block, (k, 4 * r + 3), y3 * d3)
    return y0, y1, y2, y3


@inner
def _subtract(target: Array, i: int, e: int, y: Row, block: Array, k: int, c: int) -> None:
    """Subtract y . z from element e of block i, z being row c of a block of L in column k."""
    # Always in this order, from component 0 to 3: another one would round otherwise.
    s = load(target, (i, e))
    s = fma(-y[0], load(block, (k, 4 * c)), s)
    s = fma(-y[1], load(block, (k, 4 * c + 1)), s)
    s = fma(-y[2], load(block, (k, 4 * c + 2)), s)
    s = fma(-y[3], load(block, (k, 4 * c + 3)), s)
    put(target, (i, e), s)


@inner
def forward(system: System, right: Array, first: int) -> None:
    """Substitute forwards, in place: `right` becomes L^-1 `right`.

    Args:
        system: as `factor` left it.
        right: (n + 1, 4, LANES), the corner's last; of that block 3 are used.
        first: blocks before this one are zero in every lane.
    """
    diag, near, far, arrow = system
    n = len(near)  # block n of the diagonal is the corner
    # the corner is last in the elimination, so it gathers what every column's arrow takes from it
    c0, c1, c2 = load(right, (n, 0)), load(right, (n, 1)), load(right, (n, 2))
    for k in range(first, n):
        # the unit lower triangle of the pivot block, then its blocks below, column by column
        y0 = load(right, (k, 0))
        y1 = fma(-load(diag, (k, 1)), y0, load(right, (k, 1)))
        y2 = fma(-load(diag, (k, 4)), y1, fma(-load(diag, (k, 3)), y0, load(right, (k, 2))))
        y3 = fma(-load(diag, (k, 7)), y1, fma(-load(diag, (k, 6)), y0, load(right, (k, 3))))
        y3 = fma(-load(diag, (k, 8)), y2, y3)
        put(right, (k, 1), y1)
        put(right, (k, 2), y2)
        put(right, (k, 3), y3)
        y = y0, y1, y2, y3
        if k + 1 < n:
            for r in range(4):
                _subtract(right, k + 1, r, y, near, k, r)
        if k + 2 < n:
            for r in range(3):
                _subtract(right, k + 2, r, y, far, k, r)
        c0 = fma(-load(arrow, (k, 0)), y0, fma(-load(arrow, (k, 1)), y1, c0))
        c0 = fma(-load(arrow, (k, 2)), y2, fma(-load(arrow, (k, 3)), y3, c0))
        c1 = fma(-load(arrow, (k, 4)), y0, fma(-load(arrow, (k, 5)), y1, c1))
        c1 = fma(-load(arrow, (k, 6)), y2, fma(-load(arrow, (k, 7)), y3, c1))
        c2 = fma(-load(arrow, (k, 8)), y0, fma(-load(arrow, (k, 9)), y1, c2))
        c2 = fma(-load(arrow, (k, 10)), y2, fma(-load(arrow, (k, 11)), y3, c2))
    # the corner's own unit triangle, once all columns have had their part
    c1 = fma(-load(diag, (n, 1)), c0, c1)
    c2 = fma(-load(diag, (n, 3)), c0, fma(-load(diag, (n, 4)), c1, c2))
    put(right, (n, 0), c0)
    put(right, (n, 1), c1)
    put(right, (n, 2), c2)
    # the corner has no spin: what stands there is read with the others, so it must be a number
    put(right, (n, 3), 0.0)


@inner
def backward(system: System, right: Array) -> None:
    """Substitute backwards, in place: right = L^-1 b becomes the solution."""
    diag, near, far, arrow = system
    n = len(near)  # block n of the diagonal is the corner
    # Solve L^T x = D^-1 y. The diagonals hold inverse pivots, so D^-1 is a multiplication. The
    # corner comes first, as the last unknown.
    a2 = load(right, (n, 2)) * load(diag, (n, 5))
    a1 = fma(load(right, (n, 1)), load(diag, (n, 2)), -load(diag, (n, 4)) * a2)
    a0 = fma(load(right, (n, 0)), load(diag, (n, 0)), -load(diag, (n, 1)) * a1)
    a0 = fma(-load(diag, (n, 3)), a2, a0)
    put(right, (n, 0), a0)
    put(right, (n, 1), a1)
    put(right, (n, 2), a2)
    for k in range(n - 1, -1, -1):
        w0 = load(right, (k, 0)) * load(diag, (k, 0))
        w1 = load(right, (k, 1)) * load(diag, (k, 2))
        w2 = load(right, (k, 2)) * load(diag, (k, 5))
        w3 = load(right, (k, 3)) * load(diag, (k, 9))
        # rows below block k are known by now: the arrow's, then those of blocks k + 2 and k + 1
        w = w0, w1, w2, w3
        for r in range(3):
            w = _less_row(w, arrow, k, r, load(right, (n, r)))
        if k + 2 < n:
            for r in range(3):
                w = _less_row(w, far, k, r, load(right, (k + 2, r)))
        if k + 1 < n:
            for r in range(4):
                w = _less_row(w, near, k, r, load(right, (k + 1, r)))
        w0, w1, w2, w3 = w
        # the transposed unit triangle of the pivot block, from its last row up
        w2 = fma(-load(diag, (k, 8)), w3, w2)
        w1 = fma(-load(diag, (k, 4)), w2, fma(-load(diag, (k, 7)), w3, w1))
        w0 = fma(-load(diag, (k, 1)), w1, fma(-load(diag, (k, 3)), w2, w0))
        w0 = fma(-load(diag, (k, 6)), w3, w0)
        put(right, (k, 0), w0)
        put(right, (k, 1), w1)
        put(right, (k, 2), w2)
        put(right, (k, 3), w3)


@inner
def _less_row(w: Row, block: Array, k: int, r: int, x: Any) -> Row:
    """Return w - b x, b being row r of a block of L in column k."""
    return (
        fma(-load(block, (k, 4 * r)), x, w[0]),
        fma(-load(block, (k, 4 * r + 1)), x, w[1]),
        fma(-load(block, (k, 4 * r + 2)), x, w[2]),
        fma(-load(block, (k, 4 * r + 3)), x, w[3]),
    )
