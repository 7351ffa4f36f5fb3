"""Names of arrays by what they hold, for annotations; shape and unit are told where an array is named.

A bare ``np.ndarray`` holds anything, and a checker of types does not know what is computed from it. It stands where an array may hold any
numbers, such as the stored values of a frame. What NumPy's functions return is often unknown too; an annotated name says what it is:
``root: Array = np.sqrt(x)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
