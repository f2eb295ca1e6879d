"""Compiled loops of `photo`: surfaces, the rope in two layers, and the camera's noise.

Arithmetic is + - * / and sqrt alone, in float32 without fastmath, so that the same numbers give the
same bytes on every processor. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).

After a change run `pytest tests/photos/test_photo.py`: answers must be those of an outside
computation.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import inlined, kernel

Array = NDArray[Any]

_F, _U = np.float32, np.uint32
FAR = _F(1e9)  # squared distance of pixels that no piece is near
UNDER, OVER, FIRST, LAST = 1, 2, 4, 8  # flags of a piece: its layers, and ends of the upper one
CLOTH, WOOD, GRADIENT, NOISE = 0, 1, 2, 3
PLAIN, LAID, BRAID, FLAT = 0, 1, 2, 3  # weaves
_TURN = _F(6.2831853)
# beside these float32 stays float32; Python's own numbers would make it float64
_ZERO, _HALF, _ONE = _F(0), _F(0.5), _F(1)


@inlined
def _smooth_noise(texture: Array, x: Any, y: Any) -> Any:
    """Interpolate a periodic texture, float32 (64, 64), at a point."""
    column, row = int(np.floor(x)), int(np.floor(y))
    x, y = x - _F(column), y - _F(row)
    # the texture repeats every 64 cells, so an index is its last six bits
    c, d, r, s = column & 63, (column + 1) & 63, row & 63, (row + 1) & 63
    upper = texture[r, c] + x * (texture[r, d] - texture[r, c])
    lower = texture[s, c] + x * (texture[s, d] - texture[s, c])
    return upper + y * (lower - upper)


@kernel
def surface(
    out: Array, kind: int, texture: Array, axes: Array, first: Array, last: Array, dots: Array
) -> None:
    """Paint a surface.

    Args:
        out: uint8 (size, size, 3); overwritten.
        kind: CLOTH, WOOD, GRADIENT or NOISE.
        texture: float32 (64, 64), random in [0, 1).
        axes: float32 (2, 3); (x, y, 1) of a pixel is taken to the surface's units: a thread, a ring
            of wood, a spot of noise, the picture's side.
        first, last: float32 (3,), RGB where the pattern is 0 and 1.
        dots: int64 (m, 2), column and row of the pixels to paint; none for all.
    """
    few, size = len(dots), len(out)
    for line in range(1 if few else size):
        for item in range(few or size):
            column, row = (dots[item, 0], dots[item, 1]) if few else (item, line)
            px, py = _F(column) + _HALF, _F(row) + _HALF
            x = axes[0, 0] * px + axes[0, 1] * py + axes[0, 2]
            y = axes[1, 0] * px + axes[1, 1] * py + axes[1, 2]
            if kind == GRADIENT:
                value = x + _HALF
            elif kind == NOISE:
                # three octaves, each a third as wide and weaker than the one before: spots of
                # several sizes
                value = _HALF * _smooth_noise(texture, x, y)
                value += _F(0.3) * _smooth_noise(texture, 3 * x, 3 * y)
                value += _F(0.2) * _smooth_noise(texture, 9 * x, 9 * y)
            elif kind == CLOTH:
                # the thread on top alternates; each is brightest along its middle
                warp, weft = np.floor(x), np.floor(y)
                if (int(warp) + int(weft)) & 1:
                    off, tone = x - warp - _HALF, texture[int(warp) & 63, 0]
                else:
                    off, tone = y - weft - _HALF, texture[int(weft) & 63, 1]
                value = _F(0.75) - 2 * off * off + _F(0.35) * (tone - _HALF)
            else:
                # rings bent by slow noise: early wood turns slowly into late wood and ends at once
                bent = y + 6 * _smooth_noise(texture, _F(0.03) * x, _F(0.25) * y)
                phase = bent - np.floor(bent)
                value = _HALF * min(phase * _F(1.4), (_ONE - phase) * _F(4))
                value += _HALF * _smooth_noise(texture, _F(0.3) * x, 6 * y)
            value = min(max(value, _ZERO), _ONE)
            for c in range(3):
                out[row, column, c] = np.uint8(first[c] + value * (last[c] - first[c]))


@kernel
def shapes(
    picture: Array, hidden: Array, outlines: Array, colours: Array, shift: Array, dark: Any
) -> None:
    """Paint flat convex shapes with soft shadows, one over the other.

    Args:
        picture: uint8 (size, size, 3); changed.
        hidden: uint8 (size, size), set to 1 where a shape is.
        outlines: float32 (n, sides + 1, 3). Row 0 is the middle x, y and the farthest corner, px;
            the others are sides: an outward normal, and the distance from the middle to the side.
        colours: float32 (n, 3).
        shift: float32 (2,), of the shadows, px.
        dark: share of light that a shadow takes.
    """
    size, soft = len(picture), _F(2) + abs(shift[0]) + abs(shift[1])
    for k in range(len(outlines)):
        x, y, reach = outlines[k, 0]
        reach += 2 * soft
        for row in range(max(int(y - reach), 0), min(int(y + reach) + 1, size)):
            for column in range(max(int(x - reach), 0), min(int(x + reach) + 1, size)):
                px, py = _F(column) + _HALF - x, _F(row) + _HALF - y
                # inside a convex shape every side's distance is negative; the largest tells how far
                # the outside is
                out = shade = -FAR
                for s in range(1, outlines.shape[1]):
                    nx, ny, off = outlines[k, s]
                    out = max(out, nx * px + ny * py - off)
                    shade = max(shade, nx * (px - shift[0]) + ny * (py - shift[1]) - off)
                # a pixel half covered lies on the side itself: antialiasing by distance
                cover = min(max(_HALF - out, _ZERO), _ONE)
                lit = min(max(_HALF - shade / soft, _ZERO), _ONE)
                lit = 1 - _F(dark) * lit
                hidden[row, column] |= cover > 0.5
                for c in range(3):
                    below = lit * picture[row, column, c]
                    picture[row, column, c] = np.uint8(below + cover * (colours[k, c] - below))


@kernel
def layers(visits: Array, goes_over: Array, n: int) -> Array:
    """Return the flags of n pieces, uint8; see UNDER.

    Args:
        visits: float64 (2 nx,), sorted places.
        goes_over: bool (2 nx,).
    """
    m, ahead, upper, flags = len(visits), 0, np.empty(n, np.bool_), np.empty(n, np.uint8)
    for k in range(n):
        # the nearest visit, ahead or behind, round the closed curve
        middle = k + 0.5
        while ahead < m and visits[ahead] < middle:
            ahead += 1
        upper[k] = False
        if m:
            last = visits[ahead - 1] if ahead else visits[m - 1] - n
            coming = visits[ahead] if ahead < m else visits[0] + n
            nearer = coming - middle < middle - last
            upper[k] = goes_over[(ahead if nearer else ahead - 1) % m]
    for k in range(n):
        before, after = upper[k - 1], upper[(k + 1) % n]
        # the lower layer goes on for two pieces below the upper one
        inside = before and after and upper[k - 2] and upper[(k + 2) % n]
        above = OVER + UNDER * (not inside) + FIRST * (not before) + LAST * (not after)
        flags[k] = above if upper[k] else UNDER
    return flags


@kernel
def stamp(
    curve: Array, after: Array, flags: Array, reach: Any, square: Array, place: Array
) -> None:
    """Find the nearest piece of each layer at every pixel within reach.

    Args:
        curve: float32 (n, 3), px; piece k leads from curve[k] to curve[after[k]].
        after: int64 (n,), k itself for no piece.
        flags: uint8 (n,), see UNDER.
        reach: px.
        square, place: float32 (2, size, size), squared distance, and place along the curve in
            pieces, of the lower and the upper layer; `square` must hold FAR.
    """
    size, limit = square.shape[1], _F(reach * reach)
    for k in range(len(curve)):
        if after[k] == k:
            continue
        x0, y0 = curve[k, 0], curve[k, 1]
        dx, dy = curve[after[k], 0] - x0, curve[after[k], 1] - y0
        # a piece without a length is a point; 1e-9 keeps it from being NaN
        inverse = _ONE / max(dx * dx + dy * dy, _F(1e-9))
        left, right = int(max(min(x0, x0 + dx) - reach, 0)), int(max(x0, x0 + dx) + reach) + 1
        top, bottom = int(max(min(y0, y0 + dy) - reach, 0)), int(max(y0, y0 + dy) + reach) + 1
        for row in range(top, min(bottom, size)):
            py = _F(row) + _HALF - y0
            for column in range(left, min(right, size)):
                px = _F(column) + _HALF - x0
                # where along the piece the pixel's nearest point is: projected, then clamped
                t = (px * dx + py * dy) * inverse
                # the upper layer ends square, on the lower one, which goes on below it
                upper = flags[k] & OVER and not (
                    (t < 0 and flags[k] & FIRST) or (t > 1 and flags[k] & LAST)
                )
                # a place belongs to this piece, not to the beginning of the next
                t = min(max(t, _ZERO), _F(0.9999))
                ex, ey = px - t * dx, py - t * dy
                d = ex * ex + ey * ey
                if d > limit:
                    continue
                if upper and d < square[1, row, column]:
                    square[1, row, column], place[1, row, column] = d, _F(k) + t
                if flags[k] & UNDER and d < square[0, row, column]:
                    square[0, row, column], place[0, row, column] = d, _F(k) + t


@inlined
def _arcsine_share(u: Any) -> Any:
    """Return arcsin(u) / (2 pi) (Abramowitz and Stegun 4.4.45)."""
    a = abs(u)
    bent = _F(1.5707288) + a * (_F(-0.2121144) + a * (_F(0.074261) - a * _F(0.0187293)))
    share = (_F(1.5707963) - np.sqrt(max(_ONE - a, _ZERO)) * bent) / _TURN
    return share if u >= 0 else -share


@inlined
def _woven(weave: int, turn: Any, u: Any, texture: Array) -> Any:
    """Return what a weave makes of a point of a rope.

    Args:
        weave, texture: as in `compose`.
        turn: length up to the point, turns of the texture.
        u: across the rope, -1 to 1.

    Returns:
        u of the round rope that shades alike; the strand, 0 or 1; brightness of its groove; how far
        it leans along the rope; factor on the radius; and brightness of its fibres.
    """
    which, groove, lean, bulge, fibre = 0, _ONE, _ZERO, _ONE, _ONE
    if weave == LAID:
        # two strands round the rope: angle round the axis plus twist along it, in strands
        v = 2 * (turn + _arcsine_share(u))
        which = int(np.floor(v)) & 1
        v -= np.floor(v)
        bump = 4 * v * (_ONE - v)
        groove = _F(0.45) + _F(0.55) * min(_ONE, _F(1.7) * bump)
        lean = _F(0.9) * v - _F(0.45)
        bulge = _F(0.92) + _F(0.08) * bump
        fibre = _F(0.88) + _F(0.2) * _smooth_noise(texture, 6 * v, 9 * turn)
    elif weave > LAID:
        # strands wind round the rope both ways, and lie on top of each other in turn
        share = _arcsine_share(u) if weave == BRAID else _F(0.2) * u
        v, w = 4 * (turn + share), 4 * (turn - share)
        which = (int(np.floor(v)) + int(np.floor(w))) & 1
        v = (v - np.floor(v) if which else w - np.floor(w)) - _HALF
        groove = _ONE - _F(1.4) * v * v
        fibre = _F(0.85) + _F(0.25) * _smooth_noise(texture, 9 * v, 9 * turn)
        if weave == FLAT:
            u *= u * u * u * u  # as good as level up to its edges
    return u, which, groove, lean, bulge, fibre


@kernel
def compose(
    picture: Array, strands: Array, visits: Array, square: Array, place: Array, curve: Array,
    after: Array, tangent: Array, along: Array, colours: Array, lamp: Array, weave: int,
    texture: Array, grown: Any, here: int, dots: Array
) -> None:  # fmt: skip
    """Paint both layers and their shadows on a surface.

    Args:
        picture: uint8 (size, size, 3); changed.
        strands: uint8 (size, size), 0; set to the edge of the PD code that is visible.
        visits: float64 (2 nx,), sorted places of the visits.
        square, place, curve, after: as in `stamp`.
        tangent: float32 (n, 3), unit.
        along: float32 (n,), length in space up to each point, in turns of the texture.
        colours: float32 (n, 2, 3), RGB of the two strands of the twist.
        lamp: float32 (7,): radius of the rope, px; strengths of highlight, light without direction
            and shadows; unit vector towards the light, y down.
        weave: PLAIN, LAID of two strands, BRAID or FLAT.
        texture: float32 (64, 64), of fibres.
        grown: pieces; an upper piece casts no shadow on places as near along the rope.
        own: number of points of the rope itself; those of others follow.
        dots: int64 (m, 2), column and row of the pixels to paint, no pixel twice; none for all.
    """
    size, n, light, few = len(picture), len(curve), lamp[4:], len(dots)
    radius, gloss, ambient, dark = lamp[0], lamp[1], lamp[2], lamp[3]
    # the half vector between the light and the eye, which looks down the z axis (Blinn)
    hx, hy, hz = light[0], light[1], light[2] + _ONE
    norm = _ONE / np.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    # the shadow falls away from the light, about as far as the rope is thick
    right, down = int(np.floor(radius * light[0] + _HALF)), int(np.floor(radius * light[1] + _HALF))
    soft, near = _F(0.8) * radius + _ONE, _F(0.7) * radius + _ONE
    colour = np.empty(3, np.float32)
    for line in range(1 if few else size):
        for item in range(few or size):
            column, row = (dots[item, 0], dots[item, 1]) if few else (item, line)
            r, c = min(max(row + down, 0), size - 1), min(max(column + right, 0), size - 1)
            nearest = min(square[0, row, column], square[1, row, column])
            if min(nearest, square[0, r, c], square[1, r, c]) == FAR:
                continue
            d = np.sqrt(min(square[0, r, c], square[1, r, c]))
            s = min(max(_HALF + (radius - d) / (2 * soft), _ZERO), _ONE)
            # smoothstep of the distance: a soft edge; the second shadow is contact, darkest beside
            # the rope
            lit = _ONE - _F(0.7) * dark * s * s * (3 - 2 * s)
            low, high = np.sqrt(square[0, row, column]), np.sqrt(square[1, row, column])
            s = min(max(_ONE - (min(low, high) - radius) / near, _ZERO), _ONE)
            lit -= _HALF * dark * s * s * lit
            for i in range(3):
                colour[i] = lit * picture[row, column, i]
            # where both layers show the same stretch of rope, the nearer one is right
            apart = abs(place[0, row, column] - place[1, row, column])
            same = max(low, high) < radius + near and min(apart, _F(here) - apart) <= grown
            upper = high < low if same else high < radius
            p = place[1, row, column] if upper else place[0, row, column]
            if min(low, high) < radius and p < here:
                # edge k leads to visit k, edge 1 passes the base
                passed = np.searchsorted(visits, p, side="right")
                strands[row, column] = passed % max(len(visits), 1) + 1
            for layer in range(2):
                d = high if layer else low
                if d >= radius + _HALF or (same and upper != (layer == 1)):
                    continue
                p = place[layer, row, column]
                k = min(int(p), n - 1)
                t, j = p - _F(k), after[k]
                tx = tangent[k, 0] + t * (tangent[j, 0] - tangent[k, 0])
                ty = tangent[k, 1] + t * (tangent[j, 1] - tangent[k, 1])
                tz = tangent[k, 2] + t * (tangent[j, 2] - tangent[k, 2])
                # length of the tangent in the picture; small where the rope rises towards the eye
                flat = np.sqrt(tx * tx + ty * ty) + _F(1e-6)
                px = _F(column) + _HALF - curve[k, 0] - t * (curve[j, 0] - curve[k, 0])
                py = _F(row) + _HALF - curve[k, 1] - t * (curve[j, 1] - curve[k, 1])
                # across the rope, -1 to 1, signed by the side of the tangent; a round section is
                # sqrt(1 - u^2) high
                u = min(d / radius, _ONE) if tx * py - ty * px >= 0 else -min(d / radius, _ONE)
                turn = along[k] + t * (along[k + 1] - along[k])
                u, which, groove, lean, bulge, fibre = _woven(weave, turn, u, texture)
                edge, rise = radius * bulge, np.sqrt(_ONE - u * u)
                cover = min(edge - d + _HALF, _ONE)
                if cover <= 0:
                    continue
                # normal: across the rope, out of it towards the camera, and along the twist
                nx = -u * ty / flat - rise * tz * tx / flat + lean * tx
                ny = u * tx / flat - rise * tz * ty / flat + lean * ty
                nz = rise * flat + lean * tz
                norm = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz)
                diffuse = max((nx * light[0] + ny * light[1] + nz * light[2]) * norm, _ZERO)
                sheen = max((nx * hx + ny * hy + nz * hz) * norm, _ZERO)
                # the sixteenth power by four squarings: + - * / and sqrt alone round alike
                # everywhere
                for _ in range(4):
                    sheen *= sheen
                sky = ambient * (_HALF + _HALF * rise)
                shade = fibre * groove * (sky + (_ONE - ambient) * _F(1.1) * diffuse)
                if layer == 0 and high < radius + near and not same:
                    s = min(_ONE - (high - radius) / near, _ONE)
                    shade *= _ONE - _F(0.95) * dark * s
                glint = _F(170) * gloss * sheen * groove
                for i in range(3):
                    colour[i] += cover * (shade * colours[k, which, i] + glint - colour[i])
            for i in range(3):
                picture[row, column, i] = np.uint8(min(max(colour[i] + _HALF, _ZERO), _F(255)))


@kernel
def expose(picture: Array, gain: Array, slope: Array, deviation: Any, seed: int) -> None:
    """Apply the lamp's colour and falloff, and add noise of brightness and, less, of colour.

    Args:
        picture: uint8 (size, size, 3); changed.
        gain: float32 (3,), of RGB.
        slope: float32 (3,), change of light over the picture, right and down, and loss at corners,
            shares.
        deviation: of the noise, levels.
    """
    size, byte = len(picture), _U(255)
    scale = _F(deviation) / _F(147.8)  # the sum of four bytes deviates by so much
    for row in range(size):
        for column in range(size):
            # a hash of the pixel's number (Wellons' lowbias32)
            x = _U(seed + row * size + column)
            x = _U((x ^ (x >> _U(16))) * _U(0x7FEB352D))
            x = _U((x ^ (x >> _U(15))) * _U(0x846CA68B))
            x ^= x >> _U(16)
            y = _U(x * _U(0x9E3779B1))
            low = (x & byte) + ((x >> _U(8)) & byte) + ((x >> _U(16)) & byte) + (x >> _U(24))
            high = (y >> _U(24)) + ((y >> _U(16)) & byte)
            # a sum of four bytes has mean 510 and is nearly normal; two bytes, of colour, have mean
            # 255
            grey = _F(np.int32(low) - 510) * scale + _HALF
            tint = _F(np.int32(high) - 255) * scale * _HALF
            right, down = _F(column) / size - _HALF, _F(row) / size - _HALF
            light = 1 + slope[0] * right + slope[1] * down
            light -= slope[2] * 2 * (right * right + down * down)
            for c in range(3):
                level = picture[row, column, c] * light * gain[c] + grey + _F(1 - c) * tint
                picture[row, column, c] = np.uint8(min(max(level, _ZERO), _F(255)))
