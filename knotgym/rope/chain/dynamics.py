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
step and that softness go to zero, MuJoCo comes to this model: `benchmarks/chain.py converge` at
f6d1acb. All arrays end with an axis of LANES ropes, see `simd`.

After a change run `pytest -m 'thorough or not thorough'
tests/rope/chain/test_chain_equations.py`: velocities must be those of the dense system; then
`python benchmarks/chain.py distance`, see `solver`.
"""

import numpy as np

from knotgym.common import Array, inlined, inner, kernel
from knotgym.rope.chain import layout
from knotgym.rope.chain.banded import System
from knotgym.rope.chain.layout import Physics
from knotgym.rope.chain.simd import LANES, fma, load, put
from knotgym.rope.chain.vectors import along, cross, dot, minus, norm, put_vector, unit, vector


@inner
def tangents(x: Array, v: Array, ahead: Array, tangent: Array) -> None:
    """Write unit vectors along the edges as they will lie in `ahead` seconds."""
    n = len(x)
    h = load(ahead, (0,))
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        edge = minus(vector(x, j), vector(x, i))
        put_vector(tangent, i, unit(along(edge, h, minus(vector(v, j), vector(v, i)))))


@inner
def assemble(
    tangent: Array,
    side: Array,
    v: Array,
    spin: Array,
    pull: Array,
    step: Array,
    physics: Physics,
    system: System,
    right: Array,
) -> None:
    """Write the linear system of a substep, as `banded` lays it out.

    Args:
        tangent, side: (n, 3, LANES), unit vectors along the edges and of the beads' first axes.
        v, spin: (n, 3, LANES) and (n, LANES), velocities when the substep begins; the drag is made
            linear about them.
        pull: (n, 3, LANES), forces on the vertices, newtons.
        step: (1, LANES), seconds.
        physics: of the rope; the joint at vertex 0 must not be damped.
        system: written, not yet factored.
        right: (n + 1, 4, LANES), written.
    """
    diag, near, far, _ = system
    n, damping = len(tangent), physics.damping
    joint, bead = np.empty((n, 13, LANES)), np.empty((n, 12, LANES))
    length, stiff = physics.length, physics.stretch
    # Everything is divided by the substep: inertia becomes m / h, in kg/s, and stands beside
    # damping. Half of a bead's motion belongs to either vertex, hence the quarter.
    rate = 1.0 / load(step, (0,))
    centre = 0.25 * physics.mass * rate
    transverse = physics.transverse / (length * length) * rate
    turn = physics.drag_turn / (length * length * length)
    roll = physics.round * rate
    across, fore = 0.5 * physics.drag_across, 0.5 * physics.drag_along
    for i in range(n + 1):
        for c in range(4):
            put(right, (i, c), 0.0)
    for i in range(n):
        h = i - 1 if i > 0 else n - 1
        j = i + 1 if i + 1 < n else 0
        t, u = vector(tangent, i), vector(tangent, h)
        # Joint i, between beads h and i. Of c |w_i - w_h|^2 / 2 the mixed term of a_h and a_i is
        # -a_h^T X a_i with X = c / L^2 ((t_h . t_i) 1 - t_i t_h^T), as (t x a) . (t' x a') is
        # (t . t') (a . a') - (t . a') (t' . a). Spins are coupled with a by n = c / L t_i x t_h:
        # -s_i n . a_h + s_h n . a_i. X stands at BEND_0, n at TWIST_0, c t_h . t_i at COSINE.
        bend, twist = damping[i] / (length * length), damping[i] / length
        cosine, turned = dot(t, u), cross(t, u)
        for a in range(3):
            for b in range(3):
                x = bend * fma(-t[a], u[a], cosine) if a == b else -bend * t[a] * u[b]
                put(joint, (i, layout.BEND_0 + 3 * a + b), x)
            put(joint, (i, layout.TWIST_0 + a), twist * turned[a])
        put(joint, (i, layout.COSINE), damping[i] * cosine)
        # Drag on bead i: p is its side, q the third axis. Each vertex takes half of the force
        # and half of the centre's motion is its own, so k becomes 2 k / 4 in the matrix and k / 2
        # at the right: `across` and `fore` are k / 2.
        p = vector(side, i)
        q = cross(t, p)
        vi, vj = vector(v, i), vector(v, j)
        middle = 0.5 * (vi[0] + vj[0]), 0.5 * (vi[1] + vj[1]), 0.5 * (vi[2] + vj[2])
        on_p, on_q, on_t = dot(middle, p), dot(middle, q), dot(middle, t)
        rp, rq, rt = across * abs(on_p), across * abs(on_q), fore * abs(on_t)
        # Terms in a_i alone. That a has no part along t is kept by STRETCH, so |t x a|^2 = |a|^2;
        # what turning resists is small, and taken as equal about both axes across.
        ai = minus(vj, vi)
        whirl = turn * norm(ai)
        apart = transverse + 2.0 * whirl + (damping[i] + damping[j]) / (length * length)
        # With C, of the part u^T C u of the centre, and S, of that a^T S a of the difference, the
        # lower triangle of C + S stands at SUM_0 of `bead`, that of C - S at LESS_0. As p p^T +
        # q q^T + t t^T = 1, C = rq 1 + (rp - rq) p p^T + (rt - rq) t t^T.
        dp, dt, same = rp - rq, rt - rq, rq + centre
        e = 0
        for a in range(3):
            for b in range(a + 1):
                tt = t[a] * t[b]
                one = fma(dt, tt, same) if a == b else dt * tt
                two = fma(stiff, tt, apart) if a == b else stiff * tt
                one = fma(dp, p[a] * p[b], one)
                put(bead, (i, layout.SUM_0 + e), one + two)
                put(bead, (i, layout.LESS_0 + e), one - two)
                e += 1
        # Right side: momenta of the old velocities, and the part -|u'| u' of the drag. The
        # centre's share is the same for both vertices, that of turning opposite.
        op, oq, ot = rp * on_p, rq * on_q, rt * on_t
        for c in range(3):
            back = fma(op, p[c], fma(oq, q[c], ot * t[c]))
            back = fma(centre, vi[c] + vj[c], back)
            swing = fma(transverse, ai[c], whirl * ai[c])
            put(right, (i, c), load(right, (i, c)) + (back - swing))
            put(right, (j, c), load(right, (j, c)) + (back + swing))
        own = load(spin, (i,))
        spun = physics.drag_roll * abs(own)
        put(diag, (i, layout.SPIN_DIAGONAL), damping[i] + damping[j] + roll + 2.0 * spun)
        put(right, (i, layout.SPIN), fma(roll, own, spun * own))
    # Blocks: with a_h = v_i - v_h and a_i = v_j - v_i, each X of joint i adds X + X^T at (i, i),
    # -X^T at (j, i) and (i, h), and X^T at (j, h).
    for i in range(n):
        h = i - 1 if i > 0 else n - 1
        j = i + 1 if i + 1 < n else 0
        e = 0
        for a in range(3):
            for b in range(a + 1):
                own = load(joint, (i, layout.BEND_0 + 3 * a + b)) + load(
                    joint, (i, layout.BEND_0 + 3 * b + a)
                )
                put(
                    diag,
                    (i, e),
                    load(bead, (i, layout.SUM_0 + e)) + load(bead, (h, layout.SUM_0 + e)) + own,
                )
                e += 1
        for a in range(3):
            put(diag, (i, layout.SPIN_ROW + a), -load(joint, (i, layout.TWIST_0 + a)))
            for b in range(3):
                low, up = max(a, b), min(a, b)
                s = load(bead, (i, layout.LESS_0 + low * (low + 1) // 2 + up))
                s -= load(joint, (i, layout.BEND_0 + 3 * b + a)) + load(
                    joint, (j, layout.BEND_0 + 3 * b + a)
                )
                put(near, (i, 4 * a + b), s)
                put(far, (i, 4 * a + b), load(joint, (j, layout.BEND_0 + 3 * b + a)))
            turned = load(joint, (j, layout.TWIST_0 + a))
            put(near, (i, 4 * a + layout.SPIN), -turned)
            put(near, (i, 4 * layout.SPIN + a), turned)
            put(far, (i, 4 * a + layout.SPIN), turned)
            put(right, (i, a), load(right, (i, a)) + load(pull, (i, a)))
        put(near, (i, 4 * layout.SPIN + layout.SPIN), -load(joint, (j, layout.COSINE)))
    _cut(system, right)


@inlined
def _cut(system: System, right: Array) -> None:
    """Make vertex 0's velocity the last unknown; its place in block 0 is left empty."""
    diag, near, far, arrow = system
    n = len(near)
    for k in range(n):
        for c in range(12):
            put(arrow, (k, c), 0.0)
    # The corner has no spin, but is multiplied like the other blocks, by a number.
    put(diag, (n, layout.SPIN_DIAGONAL), 0.0)
    # The 3 x 3 of vertex 0 moves to the corner; a unit matrix stays, so that it can be factored.
    for e in range(6):
        put(diag, (n, e), load(diag, (0, e)))
        put(diag, (0, e), 1.0 if e == 0 or e == 2 or e == 5 else 0.0)
    for a in range(3):
        put(diag, (0, layout.SPIN_ROW + a), 0.0)
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


@inner
def set_lengths(x: Array, length: float, rounds: int) -> None:
    """Move vertices a little, in place, so that all edges get their length; Newton's method.

    Vertex i moves by q_i e_i - q_{i-1} e_{i-1}, e being unit vectors along the edges: to first
    order edge i grows by q_{i+1} e_i . e_{i+1} + q_{i-1} e_i . e_{i-1} - 2 q_i. That is a symmetric
    cyclic tridiagonal system for q; its last unknown is eliminated last, and `wing` is what couples
    the others with it.
    """
    n = len(x)
    edge = np.empty((n, 4, LANES))
    beside, wing = np.empty((n, LANES)), np.empty((n, LANES))
    inverse, share = np.empty((n, LANES)), np.empty((n, LANES))
    for _ in range(rounds):
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            apart = minus(vector(x, j), vector(x, i))
            far = norm(apart)
            shrink = 1.0 / far
            put_vector(edge, i, (shrink * apart[0], shrink * apart[1], shrink * apart[2]))
            put(edge, (i, 3), far - length)
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            # The matrix has 2 on its diagonal and -cos of the joint's angle beside it, so it is
            # positive definite unless the rope is straight all round, which no closed rope is.
            put(beside, (i,), -dot(vector(edge, i), vector(edge, j)))
        # Elimination from edge 0 on, without pivoting: the matrix is diagonally dominant. Row i + 1
        # loses `ratio` times row i, and the last row `wide` times each, which leaves `pivot` and
        # `last` for the last unknown; then the others follow backwards.
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


@kernel
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


@inner
def turn_sides(side: Array, old: Array, new: Array, spin: Array, step: Array) -> None:
    """Turn the beads' sides, in place, with their edges from `old` to `new`, and by their spins."""
    h = load(step, (0,))
    for i in range(len(side)):
        p, t, u = vector(side, i), vector(old, i), vector(new, i)
        # Smallest rotation from t to u, of p across t: p - (p . u) / (1 + t . u) (t + u)
        k = dot(p, u) / fma(t[0], u[0], fma(t[1], u[1], fma(t[2], u[2], 1.0)))
        p = along(p, -k, (t[0] + u[0], t[1] + u[1], t[2] + u[2]))
        # Then by the spin: p + angle (t x p), made perpendicular and of unit length below.
        p = along(p, h * load(spin, (i,)), cross(u, p))
        put_vector(side, i, unit(along(p, -dot(p, u), u)))
