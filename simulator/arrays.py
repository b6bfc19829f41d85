"""Defines the type of the float64 arrays that tracks, physics and camera use."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
