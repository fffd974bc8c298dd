# SPDX-License-Identifier: Apache-2.0
"""Arrays in ``.npz`` files that anybody may have written."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.libraries import ExchangeError

MOST_BYTES = 2 << 30
"""Of all arrays of a file together: a few MB may unpack to more than there is memory."""


def read_arrays(path: Path, names: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Arrays by name: all, or those of ``names`` that there are. Raises `ExchangeError`: there is
    no such file, it is damaged, or unpacks to too much."""
    try:
        # A single array, which is none, is mapped and not read.
        with np.load(path, mmap_mode="r", allow_pickle=False) as file:
            size = sum(part.file_size for part in file.zip.infolist())
            if size <= MOST_BYTES:
                return {name: file[name] for name in file.files if not names or name in names}
    except Exception as error:  # zipfile and NumPy raise a dozen kinds on damaged bytes
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        msg = f"{path}: cannot be read: {why}"
        raise ExchangeError(msg) from None
    msg = f"{path}: its arrays have {1e-9 * size:.1f} GB; {1e-9 * MOST_BYTES:.1f} is the most"
    raise ExchangeError(msg)
