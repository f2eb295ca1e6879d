import numpy as np
import pytest

from knotgym.rope import Array

ANGLES = np.linspace(0, 2 * np.pi, 40, endpoint=False)


@pytest.fixture(scope="session")
def curve() -> Array:
    """A curve of three crossings: two loops, one inside, and a strand over both."""
    return np.stack(
        [
            np.cos(ANGLES) + 0.9 * np.cos(2 * ANGLES + 0.3),
            np.sin(ANGLES) - 0.8 * np.sin(2 * ANGLES),
            0.1 * np.cos(3 * ANGLES + 0.5),
        ],
        axis=1,
    )
