"""Types of arrays, for annotations."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ids = NDArray[np.int64]  # indices of rows, beads, lanes, nodes, ...
