"""The equations of motion of the rope, for one substep: a linear system for the velocities.

The rope is a closed polyline of n edges of length L, the axes of its beads. Unknown are the
velocity v_i of each vertex and the spin s_i of each bead about its axis t_i; bead i begins at
vertex i. Its centre moves at u_i = (v_i + v_{i+1}) / 2, and it turns at

    w_i = t_i x a_i / L + s_i t_i,      a_i = v_{i+1} - v_i.

One substep h is the backward Euler step of these, each written as what it adds to the quadratic
form whose minimum is the solution (so the matrix is symmetric and positive definite, and the step
stable at any h):

    inertia    m |u_i|^2 / 2h + I |a_i|^2 / (2h L^2) + I' s_i^2 / 2h, against the old velocities;
               m a bead's mass, I and I' its moments of inertia across and along. In vertices'
               velocities the mass matrix is constant, and nothing gyroscopic remains.
    joints     c |w_i - w_{i-1}|^2 / 2, bending and twisting alike, c the joint damping; 0 at the
               joints where MuJoCo's sub-chains are joined by `connect` equalities
    chords     STRETCH (t_i . a_i)^2 / 2, a rope that can't be stretched: with a force of 0.2 N
               edges lengthen by 2e-5 m/s, and `set_lengths` undoes that
    drag       MuJoCo's `mj_inertiaBoxFluidModel`: a bead resists as the box of equal inertia, along
               each of its own axes d by itself, -k_d |u . d| (u . d), k_d = density / 2 times the
               box's face, and -q_d |w . d| (w . d) turning. Made linear about a guess u':
               |u| u ~ 2 |u'| u - |u'| u'. The axes matter: a force between two of them is up to
               30 % smaller, so beads carry the direction of their first axis, their *side*.

Directions t_i are those at the middle of the substep, extrapolated with the old velocities; with
them edges keep their length to second order, and turn by second-order steps. Inertia and drag are
first order: velocities settle within 20 ms of a change of force, and are steady afterwards.

All numbers are MuJoCo's own, read from the model; none is fitted. Left out is the softness of
MuJoCo's closures, about 77 N/m and 3 N s/m each: its rope opens there by a millimetre. As MuJoCo's
step and that softness go to zero, MuJoCo comes to this model: `benchmarks/chain.py converge`. All
arrays end with an axis of LANES ropes, see `simd`.

After a change run `pytest -m 'thorough or not thorough'
tests/rope/chain/test_chain_equations.py`: velocities must be those of the dense system; then
`python benchmarks/chain.py distance`, see `solver`.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.rope.chain.banded import System
from knotgym.rope.chain.layout import (
    ACROSS,
    ALONG,
    BEND_0,
    COSINE,
    LENGTH,
    LESS_0,
    MASS,
    ROLL,
    ROUND,
    SPIN_DIAGONAL,
    STRETCH,
    SUM_0,
    TUMBLE,
    TURN,
    TWIST_0,
)
from knotgym.rope.chain.simd import LANES, fma, load, put

Array = NDArray[np.float64]


@njit(nogil=True)
def tangents(x: Array, v: Array, ahead: Array, tangent: Array) -> None:
    """Write unit vectors along the edges as they will lie in `ahead` seconds."""
    n = len(x)
    h = load(ahead, (0,))
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        a = fma(h, load(v, (j, 0)) - load(v, (i, 0)), load(x, (j, 0)) - load(x, (i, 0)))
        b = fma(h, load(v, (j, 1)) - load(v, (i, 1)), load(x, (j, 1)) - load(x, (i, 1)))
        c = fma(h, load(v, (j, 2)) - load(v, (i, 2)), load(x, (j, 2)) - load(x, (i, 2)))
        shrink = 1.0 / math.sqrt(fma(a, a, fma(b, b, c * c)))
        put(tangent, (i, 0), shrink * a)
        put(tangent, (i, 1), shrink * b)
        put(tangent, (i, 2), shrink * c)


@njit(nogil=True)
def assemble(
    tangent: Array,
    side: Array,
    v: Array,
    spin: Array,
    guess: Array,
    guess_spin: Array,
    pull: Array,
    step: Array,
    numbers: Array,
    damping: Array,
    system: System,
    right: Array,
) -> None:
    """Write the linear system of a substep, as `banded` lays it out.

    Args:
        tangent, side: (n, 3, LANES), unit vectors along the edges and of the beads' first axes.
        v, spin: (n, 3, LANES) and (n, LANES), velocities when the substep begins.
        guess, guess_spin: about which the drag is made linear.
        pull: (n, 3, LANES), forces on the vertices, newtons.
        step: (1, LANES), seconds.
        numbers: of the model, see `layout`.
        damping: (n,), of the joints at the vertices, N m s; 0 at vertex 0.
        system: written, not yet factored.
        right: (n + 1, 4, LANES), written.
    """
    diag, near, far, _, _ = system
    n = len(tangent)
    joint, bead = np.empty((n, 13, LANES)), np.empty((n, 12, LANES))
    length = numbers[LENGTH]
    # Everything is divided by the substep: inertia becomes m / h, in kg/s, and stands beside
    # damping. Half of a bead's motion belongs to either vertex, hence the quarter.
    rate = 1.0 / load(step, (0,))
    centre = 0.25 * numbers[MASS] * rate
    tumble = numbers[TUMBLE] / (length * length) * rate
    turn = numbers[TURN] / (length * length * length)
    roll = numbers[ROUND] * rate
    across, along = 0.5 * numbers[ACROSS], 0.5 * numbers[ALONG]
    for i in range(n + 1):
        for c in range(4):
            put(right, (i, c), 0.0)
    for i in range(n):
        h = i - 1 if i > 0 else n - 1
        j = i + 1 if i + 1 < n else 0
        tx, ty, tz = load(tangent, (i, 0)), load(tangent, (i, 1)), load(tangent, (i, 2))
        # Joint i, between beads h and i. Of c |w_i - w_h|^2 / 2 the mixed term of a_h and a_i is
        # -a_h^T X a_i with X = c / L^2 ((t_h . t_i) 1 - t_i t_h^T), as (t x a) . (t' x a') is
        # (t . t') (a . a') - (t . a') (t' . a). Spins are coupled with a by n = c / L t_i x t_h:
        # -s_i n . a_h + s_h n . a_i. X stands at BEND_0, n at TWIST_0, c t_h . t_i at COSINE.
        bend, cross = damping[i] / (length * length), damping[i] / length
        ux, uy, uz = load(tangent, (h, 0)), load(tangent, (h, 1)), load(tangent, (h, 2))
        cosine = fma(tx, ux, fma(ty, uy, tz * uz))
        put(joint, (i, BEND_0 + 0), bend * fma(-tx, ux, cosine))
        put(joint, (i, BEND_0 + 1), -bend * tx * uy)
        put(joint, (i, BEND_0 + 2), -bend * tx * uz)
        put(joint, (i, BEND_0 + 3), -bend * ty * ux)
        put(joint, (i, BEND_0 + 4), bend * fma(-ty, uy, cosine))
        put(joint, (i, BEND_0 + 5), -bend * ty * uz)
        put(joint, (i, BEND_0 + 6), -bend * tz * ux)
        put(joint, (i, BEND_0 + 7), -bend * tz * uy)
        put(joint, (i, BEND_0 + 8), bend * fma(-tz, uz, cosine))
        put(joint, (i, TWIST_0 + 0), cross * fma(ty, uz, -tz * uy))
        put(joint, (i, TWIST_0 + 1), cross * fma(tz, ux, -tx * uz))
        put(joint, (i, TWIST_0 + 2), cross * fma(tx, uy, -ty * ux))
        put(joint, (i, COSINE), damping[i] * cosine)
        # Drag on bead i: p is its side, q the third axis. Each vertex takes half of the force
        # and half of the centre's motion is its own, so k becomes 2 k / 4 in the matrix and k / 2
        # at the right: `across` and `along` are k / 2.
        px, py, pz = load(side, (i, 0)), load(side, (i, 1)), load(side, (i, 2))
        qx, qy, qz = fma(ty, pz, -tz * py), fma(tz, px, -tx * pz), fma(tx, py, -ty * px)
        gx, gy, gz = load(guess, (i, 0)), load(guess, (i, 1)), load(guess, (i, 2))
        kx, ky, kz = load(guess, (j, 0)), load(guess, (j, 1)), load(guess, (j, 2))
        mx, my, mz = 0.5 * (gx + kx), 0.5 * (gy + ky), 0.5 * (gz + kz)
        one = fma(mx, px, fma(my, py, mz * pz))
        two = fma(mx, qx, fma(my, qy, mz * qz))
        fore = fma(mx, tx, fma(my, ty, mz * tz))
        r1, r2, rt = across * abs(one), across * abs(two), along * abs(fore)
        o1, o2, ot = r1 * one, r2 * two, rt * fore
        # Terms in a_i alone. That a has no part along t is kept by STRETCH, so |t x a|^2 = |a|^2;
        # what turning resists is small, and taken as equal about both axes across.
        ax, ay, az = kx - gx, ky - gy, kz - gz
        fast = math.sqrt(fma(ax, ax, fma(ay, ay, az * az)))
        whirl = turn * fast
        d1, d2, dt = r1 - r2, rt - r2, r2 + centre
        stiff = numbers[STRETCH]
        # At SUM_0 of `bead` stands the lower triangle of C + S, at LESS_0 that of C - S, where
        # u^T C u is the part of the centre and a^T S a that of the difference.
        apart = tumble + 2.0 * whirl + (damping[i] + damping[j]) / (length * length)
        xx, xy, xz = tx * tx, tx * ty, tx * tz
        yy, yz, zz = ty * ty, ty * tz, tz * tz
        cxx = fma(d1, px * px, fma(d2, xx, dt))
        cxy = fma(d1, px * py, d2 * xy)
        cxz = fma(d1, px * pz, d2 * xz)
        cyy = fma(d1, py * py, fma(d2, yy, dt))
        cyz = fma(d1, py * pz, d2 * yz)
        czz = fma(d1, pz * pz, fma(d2, zz, dt))
        sxx, sxy, sxz = fma(stiff, xx, apart), stiff * xy, stiff * xz
        syy, syz, szz = fma(stiff, yy, apart), stiff * yz, fma(stiff, zz, apart)
        put(bead, (i, SUM_0 + 0), cxx + sxx)
        put(bead, (i, SUM_0 + 1), cxy + sxy)
        put(bead, (i, SUM_0 + 2), cyy + syy)
        put(bead, (i, SUM_0 + 3), cxz + sxz)
        put(bead, (i, SUM_0 + 4), cyz + syz)
        put(bead, (i, SUM_0 + 5), czz + szz)
        put(bead, (i, LESS_0 + 0), cxx - sxx)
        put(bead, (i, LESS_0 + 1), cxy - sxy)
        put(bead, (i, LESS_0 + 2), cyy - syy)
        put(bead, (i, LESS_0 + 3), cxz - sxz)
        put(bead, (i, LESS_0 + 4), cyz - syz)
        put(bead, (i, LESS_0 + 5), czz - szz)
        for c in range(3):
            p = load(side, (i, c))
            q = qx if c == 0 else (qy if c == 1 else qz)
            back = fma(o1, p, fma(o2, q, ot * load(tangent, (i, c))))
            vi, vj = load(v, (i, c)), load(v, (j, c))
            back = fma(centre, vi + vj, back)
            # Right side: momenta of the old velocities, and the part -|u'| u' of the drag. The
            # centre's share is the same for both vertices, that of turning opposite.
            swing = fma(tumble, vj - vi, whirl * (load(guess, (j, c)) - load(guess, (i, c))))
            put(right, (i, c), load(right, (i, c)) + (back - swing))
            put(right, (j, c), load(right, (j, c)) + (back + swing))
        gs = load(guess_spin, (i,))
        spun = numbers[ROLL] * abs(gs)
        put(diag, (i, SPIN_DIAGONAL), damping[i] + damping[j] + roll + 2.0 * spun)
        put(right, (i, 3), fma(roll, load(spin, (i,)), spun * gs))
    # Blocks: with a_h = v_i - v_h and a_i = v_j - v_i, each X of joint i adds X + X^T at (i, i),
    # -X^T at (j, i) and (i, h), and X^T at (j, h).
    for i in range(n):
        h = i - 1 if i > 0 else n - 1
        j = i + 1 if i + 1 < n else 0
        e = 0
        for a in range(3):
            for b in range(a + 1):
                own = load(joint, (i, BEND_0 + 3 * a + b)) + load(joint, (i, BEND_0 + 3 * b + a))
                put(diag, (i, e), load(bead, (i, SUM_0 + e)) + load(bead, (h, SUM_0 + e)) + own)
                e += 1
        for a in range(3):
            put(diag, (i, 6 + a), -load(joint, (i, TWIST_0 + a)))
            for b in range(3):
                low, up = max(a, b), min(a, b)
                s = load(bead, (i, LESS_0 + low * (low + 1) // 2 + up))
                s -= load(joint, (i, BEND_0 + 3 * b + a)) + load(joint, (j, BEND_0 + 3 * b + a))
                put(near, (i, 4 * a + b), s)
                put(far, (i, 4 * a + b), load(joint, (j, BEND_0 + 3 * b + a)))
            turned = load(joint, (j, TWIST_0 + a))
            put(near, (i, 4 * a + 3), -turned)
            put(near, (i, 12 + a), turned)
            put(far, (i, 4 * a + 3), turned)
            put(right, (i, a), load(right, (i, a)) + load(pull, (i, a)))
        put(near, (i, 15), -load(joint, (j, COSINE)))
    _cut(system, right)


@njit(nogil=True)
def _cut(system: System, right: Array) -> None:
    """Make vertex 0's velocity the last unknown; its place in block 0 is left empty."""
    diag, near, far, arrow, corner = system
    n = len(diag)
    for k in range(n):
        for c in range(12):
            put(arrow, (k, c), 0.0)
    # The 3 x 3 of vertex 0 moves to the corner; a unit matrix stays, so that it can be factored.
    for e in range(6):
        put(corner, (e,), load(diag, (0, e)))
        put(diag, (0, e), 1.0 if e == 0 or e == 2 or e == 5 else 0.0)
    for a in range(3):
        put(diag, (0, 6 + a), 0.0)
        put(right, (n, a), load(right, (0, a)))
        put(right, (0, a), 0.0)
        for b in range(4):
            # Neighbours of vertex 0 are blocks 1 and 2 on one side, whose parts are turned over
            # because the corner comes after them, and n - 1 and n - 2 on the other.
            put(arrow, (1, 4 * a + b), load(near, (0, 4 * b + a)))
            put(near, (0, 4 * b + a), 0.0)
            put(arrow, (n - 1, 4 * a + b), load(near, (n - 1, 4 * a + b)))
            put(arrow, (n - 2, 4 * a + b), load(far, (n - 2, 4 * a + b)))
            if b < 3:
                put(arrow, (2, 4 * a + b), load(far, (0, 4 * b + a)))
                put(far, (0, 4 * b + a), 0.0)


@njit(nogil=True)
def set_lengths(x: Array, length: float, rounds: int) -> None:
    """Move vertices a little, in place, so that all edges get their length; Newton's method.

    Vertex i moves by q_i e_i - q_{i-1} e_{i-1}, e being unit vectors along the edges: to first
    order edge i grows by q_{i+1} e_i . e_{i+1} + q_{i-1} e_i . e_{i-1} - 2 q_i. That is a symmetric
    cyclic tridiagonal system for q; its last unknown is eliminated last, and `wing` is what couples
    the others with it.
    """
    n = len(x)
    edge = np.empty((n, 4, LANES))
    beside, wing, inverse, share = (
        np.empty((n, LANES)),
        np.empty((n, LANES)),
        np.empty((n, LANES)),
        np.empty((n, LANES)),
    )
    for _ in range(rounds):
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            a = load(x, (j, 0)) - load(x, (i, 0))
            b = load(x, (j, 1)) - load(x, (i, 1))
            c = load(x, (j, 2)) - load(x, (i, 2))
            far = math.sqrt(fma(a, a, fma(b, b, c * c)))
            shrink = 1.0 / far
            put(edge, (i, 0), shrink * a)
            put(edge, (i, 1), shrink * b)
            put(edge, (i, 2), shrink * c)
            put(edge, (i, 3), far - length)
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            # The matrix has 2 on its diagonal and -cos of the joint's angle beside it, so it is
            # positive definite unless the rope is straight all round, which no closed rope is.
            cosine = load(edge, (i, 2)) * load(edge, (j, 2))
            cosine = fma(load(edge, (i, 1)), load(edge, (j, 1)), cosine)
            put(beside, (i,), -fma(load(edge, (i, 0)), load(edge, (j, 0)), cosine))
        last = load(edge, (n - 1, 3))
        pivot = 2.0 + 0.0 * last
        put(wing, (0,), load(beside, (n - 1,)))
        put(share, (0,), load(edge, (0, 3)))
        put(inverse, (0,), 0.5)
        for i in range(n - 1):
            ratio = load(beside, (i,)) * load(inverse, (i,))
            wide = load(wing, (i,)) * load(inverse, (i,))
            if i + 1 < n - 1:
                put(inverse, (i + 1,), 1.0 / fma(-ratio, load(beside, (i,)), 2.0))
                put(share, (i + 1,), fma(-ratio, load(share, (i,)), load(edge, (i + 1, 3))))
                filled = -ratio * load(wing, (i,))
                if i + 1 == n - 2:  # the last but one is also its neighbour
                    filled = filled + load(beside, (n - 2,))
                put(wing, (i + 1,), filled)
            pivot = fma(-wide, load(wing, (i,)), pivot)
            last = fma(-wide, load(share, (i,)), last)
        last = last / pivot
        put(share, (n - 1,), last)
        after = 0.0 * last
        for i in range(n - 2, -1, -1):
            s = fma(-load(wing, (i,)), last, load(share, (i,)))
            if i < n - 2:
                s = fma(-load(beside, (i,)), after, s)
            after = s * load(inverse, (i,))
            put(share, (i,), after)
        for i in range(n):
            h = i - 1 if i > 0 else n - 1
            here, before = load(share, (i,)), load(share, (h,))
            for c in range(3):
                moved = fma(here, load(edge, (i, c)), -before * load(edge, (h, c)))
                put(x, (i, c), load(x, (i, c)) + moved)


@njit(cache=True, nogil=True)
def set_all_lengths(points: Array, length: float, rounds: int) -> None:
    """Apply `set_lengths` to any number of ropes (ropes, n, 3), in place."""
    ropes, n = points.shape[0], points.shape[1]
    group = np.empty((n, 3, LANES))
    for first in range(0, ropes, LANES):
        for lane in range(LANES):
            rope = min(first + lane, ropes - 1)  # lanes left over hold the last rope, too
            for i in range(n):
                for c in range(3):
                    group[i, c, lane] = points[rope, i, c]
        set_lengths(group, length, rounds)
        for rope in range(first, min(first + LANES, ropes)):
            for i in range(n):
                for c in range(3):
                    points[rope, i, c] = group[i, c, rope - first]


@njit(nogil=True)
def turn_sides(side: Array, old: Array, new: Array, spin: Array, step: Array) -> None:
    """Turn the beads' sides, in place, with their edges from `old` to `new`, and by their spins."""
    h = load(step, (0,))
    for i in range(len(side)):
        px, py, pz = load(side, (i, 0)), load(side, (i, 1)), load(side, (i, 2))
        tx, ty, tz = load(old, (i, 0)), load(old, (i, 1)), load(old, (i, 2))
        ux, uy, uz = load(new, (i, 0)), load(new, (i, 1)), load(new, (i, 2))
        # smallest rotation from t to u, of p across t: p - (p . u) / (1 + t . u) (t + u)
        k = fma(px, ux, fma(py, uy, pz * uz)) / fma(tx, ux, fma(ty, uy, fma(tz, uz, 1.0)))
        px, py, pz = fma(-k, tx + ux, px), fma(-k, ty + uy, py), fma(-k, tz + uz, pz)
        # Then by the spin: p + angle (t x p), made perpendicular and of unit length below.
        angle = h * load(spin, (i,))
        px, py, pz = (
            fma(angle, fma(uy, pz, -uz * py), px),
            fma(angle, fma(uz, px, -ux * pz), py),
            fma(angle, fma(ux, py, -uy * px), pz),
        )
        fore = fma(px, ux, fma(py, uy, pz * uz))
        px, py, pz = fma(-fore, ux, px), fma(-fore, uy, py), fma(-fore, uz, pz)
        shrink = 1.0 / math.sqrt(fma(px, px, fma(py, py, pz * pz)))
        put(side, (i, 0), shrink * px)
        put(side, (i, 1), shrink * py)
        put(side, (i, 2), shrink * pz)
