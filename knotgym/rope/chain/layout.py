"""Every packed array of the chain engine: what stands where, its shape and its unit.

n is the number of beads of a rope. Arrays marked `L` end with one more axis of LANES ropes, see
`simd`. A triangle is stored by rows, element (i, j) of it at i (i + 1) / 2 + j.

    states (ropes, n, STATE)     | X    0 1 2 | V    3 4 5 | SIDE 6 7 8 | SPUN 9 |
                                   metres       m/s          unit vector  rad/s
                                   of vertex i               of bead i, which begins at vertex i

    the system A x = b of a substep, blocks of four unknowns: velocity of vertex k, spin of bead k

        | D0                      .  |    diag   L (n + 1, 10)  D_k, lower triangle of 4 x 4
        | N0 D1                   .  |    near   L (n, 16)      N_k, 4 x 4: rows of block k + 1
        | F0 N1 D2                .  |    far    L (n, 12)      F_k, 3 x 4: velocity of block k + 2
        |    F1 N2 D3             .  |    arrow  L (n, 12)      A_k, 3 x 4: rows of the corner
        |       .  .  .           .  |    D_n is the corner, of which 3 x 3 are used;
        | A0 A1 A2 .  .          D_n |    columns of near, far, arrow: those of block k
                                          kg/s for velocities, N m s for spins

    b and x, `right`             L (n + 1, 4)   block k: velocity of vertex k, spin of bead k;
                                                block n: the corner, which is vertex 0's velocity
    of joint i, `joint`          L (n, 13)      | BEND_0 0..8, 3 x 3 | TWIST_0 9 10 11 | COSINE 12 |
    of bead i, `bead`            L (n, 12)      | SUM_0 0..5, triangle | LESS_0 6..11, triangle |
    of a contact, `rows`         L (ROWS, 8)    | ON_I | ON_J | NORMAL 2 3 4 | GAP | EDGE_I EDGE_J |
                                                  0..1   0..1   unit vector    m     edge numbers
    a lane's clock, `clock`      int64 (4, LANES)    | ROPE | STAGE | LEFT | TICK |
    a rope's counts, `counts`    int64 (ropes, 5)
                                     | SUBSTEPS | REJECTED | CONTACTS | LOST | BLOWN_UP |
    near pairs of edges          int64 start (n + 1,), other: i with other[start[i]:start[i + 1]]

After a change of any of these run `pytest tests/rope/chain`: the equations are compared with a
dense reference, lanes with each other, and the engine with MuJoCo.
"""

from typing import NamedTuple

from knotgym.common import Array


class Physics(NamedTuple):
    """What the solver needs to know of a rope; `chain_simulation._physics_of` reads it.

    Attributes:
        mass: of a bead, kg.
        transverse, round: its moments of inertia across and along its axis, kg m^2.
        length: of an edge, metres.
        drag_across, drag_along: of a bead that moves, N s^2/m^2.
        drag_turn, drag_roll: of a bead that turns across and about its axis, N m s^2.
        stretch: what an edge resists being stretched with, N s/m.
        damping: float64 (n,), N m s, of the joint at each vertex; 0 at vertex 0 and at MuJoCo's
            closures.
        radius: of a bead, metres.
        contact_stiffness, contact_damping: N/m and N s/m.
        floor: the least distance of two edges' axes, metres.
    """

    mass: float
    transverse: float
    round: float
    length: float
    drag_across: float
    drag_along: float
    drag_turn: float
    drag_roll: float
    stretch: float
    damping: Array
    radius: float
    contact_stiffness: float
    contact_damping: float
    floor: float


# a vertex, and the bead that begins there
X, V, SIDE, SPUN, STATE = 0, 3, 6, 9, 10

# in a block of unknowns 0 1 2 are the velocity; in a packed triangle its row begins at SPIN_ROW
SPIN, SPIN_ROW = 3, 6
# where the diagonal of a packed triangle stands; of the corner's, 3 x 3, the first three
DIAGONAL = (0, 2, 5, 9)
SPIN_DIAGONAL = 9

# joint i, between beads i - 1 and i
BEND_0, TWIST_0, COSINE = 0, 9, 12
# bead i: C + S and C - S, see `dynamics`
SUM_0, LESS_0 = 0, 6

# a contact between two edges
ON_I, ON_J, NORMAL, GAP, EDGE_I, EDGE_J = 0, 1, 2, 5, 6, 7
# what is tried as one: the same up to GAP, then the distance at the substep's end, and a number
# that is negative in lanes where these two edges may touch
THEN, MAY = 6, 7

# a lane's clock: its rope or -1, its entry of the schedule, ticks left of it, ticks of its substep
ROPE, STAGE, LEFT, TICK = range(4)
# counted for each rope; LOST in ticks of its action that were taken back, BLOWN_UP 0 or 1
SUBSTEPS, REJECTED, CONTACTS, LOST, BLOWN_UP = COUNTS = range(5)
