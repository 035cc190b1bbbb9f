"""The usual types of arrays by name; shapes and units are said where they are used."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Complex = NDArray[np.complex128]
Ints = NDArray[np.int32]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]
Gray = NDArray[np.uint8]
Bytes = NDArray[np.uint8]
