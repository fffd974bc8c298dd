# SPDX-License-Identifier: Apache-2.0
"""Names of array types, by what their elements are; shapes and units stand where they are used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
#: Marks, and bits of hazards.
Bytes = NDArray[np.uint8]
#: Rows and places that arrays are indexed by.
Index = NDArray[np.intp]
#: The same in half the memory, and offsets in time, ns.
Ints = NDArray[np.int32]
#: Morton keys of cells.
Keys = NDArray[np.int64]
#: Counts, numbers of places, indices of cells.
Numbers = NDArray[np.uint32]
#: As the lidar gives them.
Points = Single | Array
