# SPDX-License-Identifier: Apache-2.0
"""Reading of ``.npz`` files from unknown sources."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.libraries import ExchangeError

MAX_BYTES = 2 << 30
"""Largest total size of the arrays of a file, because a small file may expand beyond memory."""


def read_arrays(path: Path, names: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Read all arrays, or those of ``names`` that exist. Raises `ExchangeError`: the file does not
    exist, is damaged, or expands to more than `MAX_BYTES`."""
    try:
        # Memory mapping avoids reading a file with a single array, which is invalid.
        with np.load(path, mmap_mode="r", allow_pickle=False) as file:
            size = sum(part.file_size for part in file.zip.infolist())
            if size <= MAX_BYTES:
                return {name: file[name] for name in file.files if not names or name in names}
    except Exception as error:  # zipfile and NumPy raise many types on damaged files
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        msg = f"{path}: cannot be read: {why}"
        raise ExchangeError(msg) from None
    msg = f"{path}: its arrays have {1e-9 * size:.1f} GB; the limit is {1e-9 * MAX_BYTES:.1f} GB"
    raise ExchangeError(msg)
