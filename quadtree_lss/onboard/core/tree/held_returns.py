# SPDX-License-Identifier: Apache-2.0
"""Isolated returns that wait until other scans show the same place.

Objects that few pixels hit give isolated returns (`sensing.isolated`) at the same places in every
scan, noise at random ones. Two isolated returns of different scans show the same place if they
differ by no more than the gate in height and lie in the same finest cell or in neighbouring ones.
When `SHOWN` scans have shown a place, the return of the last one enters the map, and so do the
held-back returns that it confirms. Later isolated returns there enter at once.
"""

from __future__ import annotations

from typing import NamedTuple

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints, Mask, Single
from quadtree_lss.onboard.core.tree.domain import Domain, carried

#: Scans that show a place before its returns enter. Of 62,000 strays (1 % of the pixels, 400 scans
#: of 20 Hz), 1,300 entered a simulated Morpheus map with three, 3 with six.
SHOWN = 6
#: Held-back returns are compared with so many following scans; objects recur within a few scans.
LASTING = 20


class IsolatedReturns(NamedTuple):
    """The isolated returns (K,) of one scan, compared with those held back: finest cell
    iy * n + ix, -1 outside the domain; height as in `HeldReturns`; how many scans have shown the
    place, at most `SHOWN`. ``admitted``: (A,) cells whose held-back return this scan confirms."""

    cell: Index
    height: Array
    shown: Bytes
    admitted: Index

    @property
    def confirmed(self) -> Mask:
        """(K,) which enter the map."""
        return np.equal(self.shown, SHOWN)


class HeldReturns:
    """The last isolated return in each finest cell, (n, n) [iy, ix].

    Attributes:
        height: m, ``lifted`` lower than in the map, which was lifted by that since.
        scan: Number of its scan, from 1 on, of ``scans``.
        shown: How many scans have shown its place, 0 for no return, `SHOWN` if confirmed.
    """

    def __init__(self, domain: Domain) -> None:
        n = domain.finest_count
        self.height: Single = np.zeros((n, n), dtype=np.float32)
        self.scan: Ints = np.zeros((n, n), dtype=np.int32)
        self.shown: Bytes = np.zeros((n, n), dtype=np.uint8)
        self.scans = 0
        self.lifted = 0.0

    def follow(self, east: int, north: int) -> None:
        """The domain moved by so many finest cells along x and along y."""
        self.height = carried(self.height, east, north, 0.0)
        self.scan = carried(self.scan, east, north, 0)
        self.shown = carried(self.shown, east, north, 0)

    def compare(self, points_map: Array, domain: Domain, gate: float) -> IsolatedReturns:
        """Compare the isolated returns (K, 3) of a scan with those held back; change nothing."""
        n = domain.finest_count
        corner = domain.xmin, domain.ymin
        place = np.floor((points_map[:, :2] - corner) / domain.finest_size)
        inside: Mask = np.all((place >= 0) & (place < n), axis=1)
        ix, iy = np.where(inside[:, None], place, 0).astype(np.intp).T
        cell = np.where(inside, iy * n + ix, -1)
        height = points_map[:, 2] - self.lifted
        shown = np.ones(len(cell), dtype=np.uint8)
        admitted = np.empty(9 * len(cell), dtype=np.intp)
        count = find_shown(self, gate, cell, height, shown, admitted)
        return IsolatedReturns(cell, height, shown, np.unique(admitted[:count]))

    def keep(self, found: IsolatedReturns) -> None:
        """Keep the isolated returns of the last of ``scans``."""
        shown = self.shown.reshape(-1)
        shown[found.admitted] = SHOWN
        # Of one cell, the one shown most is the last.
        order = np.argsort(found.shown, kind="stable")
        order = order[found.cell[order] >= 0]
        cell = found.cell[order]
        self.height.reshape(-1)[cell] = found.height[order]
        self.scan.reshape(-1)[cell] = self.scans
        shown[cell] = found.shown[order]

    def places(self, cells: Index, domain: Domain) -> Array:
        """(A, 3) the held-back returns of cells, map frame, m, at the centres of these."""
        iy, ix = np.divmod(cells, domain.finest_count)
        x = domain.xmin + (ix + 0.5) * domain.finest_size
        y = domain.ymin + (iy + 0.5) * domain.finest_size
        return np.stack([x, y, self.height.reshape(-1)[cells] + self.lifted], axis=1)


@cython.locals(cell=cython.Py_ssize_t[::1], height=cython.double[::1], shown=cython.uchar[::1])
@cython.locals(admitted=cython.Py_ssize_t[::1])
def find_shown(
    held: HeldReturns, gate: float, cell: Index, height: Array, shown: Bytes, admitted: Index
) -> cython.Py_ssize_t:
    """Count in ``shown`` (K,) the scans that showed the places of isolated returns, and write the
    cells of held-back returns that are thereby confirmed to ``admitted`` (9 K,), some repeatedly;
    return their number."""
    cython.declare(i=cython.Py_ssize_t, ix=cython.Py_ssize_t, iy=cython.Py_ssize_t)
    heights = cython.declare(cython.float[:, ::1], held.height)
    scan = cython.declare(cython.int[:, ::1], held.scan)
    times = cython.declare(cython.uchar[:, ::1], held.shown)
    most: cython.int = SHOWN
    oldest: cython.int = held.scans - LASTING
    n: cython.Py_ssize_t = scan.shape[0]
    count: cython.Py_ssize_t = 0
    first: cython.Py_ssize_t
    for i in range(cell.shape[0]):
        if cell[i] < 0:
            continue
        first = count
        for iy in range(max(cell[i] // n - 1, 0), min(cell[i] // n + 2, n)):
            for ix in range(max(cell[i] % n - 1, 0), min(cell[i] % n + 2, n)):
                if times[iy, ix] == 0 or abs(heights[iy, ix] - height[i]) > gate:
                    continue
                if times[iy, ix] == most:
                    shown[i] = most
                elif scan[iy, ix] > oldest:
                    shown[i] = max(shown[i], times[iy, ix] + 1)
                    admitted[count] = iy * n + ix
                    count += 1
        if shown[i] < most:
            count = first
    return count
