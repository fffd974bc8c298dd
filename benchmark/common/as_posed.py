# SPDX-License-Identifier: Apache-2.0
"""Mappers with parts of the method disabled."""

import contextlib
import dataclasses
from collections.abc import Iterator
from unittest import mock

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.update import ScanUpdate


class UnalignedMapper(Mapper):
    """A mapper without the alignment of scan and map."""

    def _align(self, change: ScanUpdate, cells: Array, now: float) -> float:
        return 0.0


@contextlib.contextmanager
def lengths(**own: float) -> Iterator[None]:
    """Replace lengths of the default vehicle while a configuration and a mapper are made.

    ``outlier_gate`` 0 keeps all returns; an infinite ``feature_height`` disables features.
    """
    with mock.patch.object(VehicleConfig, "lengths", dataclasses.replace(Lengths(), **own)):
        yield
