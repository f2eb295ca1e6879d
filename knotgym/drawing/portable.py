"""Elementary functions that round alike everywhere, to 1e-15.

A drawing follows from its seed to the last bit. Mathematics libraries round sines, angles and
exponentials each in its own way, and one and the same library otherwise on a processor that
multiplies and adds at once. Sums, products, quotients and square roots are the same everywhere, so
these functions consist of them.
"""

import math

import numba
import numpy as np

# pi / 2 and log 2 as sums of two floats; multiples of the first by small integers are exact
_QUARTER = 1.5707963267341256, 6.077100506506192e-11
_LOG_2 = 0.6931471803691238, 1.9082149292705877e-10


@numba.njit(cache=True, nogil=True)
def sin_cos(x: float) -> tuple[float, float]:
    """Return the sine and the cosine of an angle of a few turns at most, radians."""
    quarters = np.rint(x / (np.pi / 2))
    x = x - quarters * _QUARTER[0] - quarters * _QUARTER[1]
    sine, cosine = 1.0, 1.0  # Taylor series from behind: the first terms left out are below 1e-17
    for k in range(18, 1, -2):
        cosine = 1 - x * x / (k * (k - 1)) * cosine
        sine = 1 - x * x / (k * (k + 1)) * sine
    sine *= x
    for _ in range(int(quarters) % 4):
        sine, cosine = cosine, -sine
    return sine, cosine


@numba.njit(cache=True, nogil=True)
def angle_of(x: float, y: float) -> float:
    """Return the angle of a vector from the x axis, in [-pi, pi]; 0 for the zero vector."""
    far = np.sqrt(x * x + y * y)
    if far == 0:
        return 0.0
    tangent = y / (far + abs(x))  # of half the angle, which is halved three times more
    for _ in range(3):
        tangent /= 1 + np.sqrt(1 + tangent * tangent)
    series = 0.0
    for k in range(19, 0, -2):
        series = 1 / k - tangent * tangent * series
    angle = 16 * tangent * series
    if x < 0:
        return float((np.pi if y >= 0 else -np.pi) - angle)
    return float(angle)


def exp(x: float) -> float:
    """Return the exponential of a number."""
    twos = round(x / math.log(2))
    x = x - twos * _LOG_2[0] - twos * _LOG_2[1]
    series = 1.0
    for k in range(16, 0, -1):
        series = 1 + x / k * series
    return math.ldexp(series, twos)
