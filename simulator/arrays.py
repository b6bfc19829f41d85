"""The type of arrays of floats, as tracks, physics and camera use them."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
