# SPDX-License-Identifier: Apache-2.0
"""Lengths of the default vehicle that disable parts of the method."""

import contextlib
import dataclasses
from collections.abc import Iterator
from unittest import mock

from quadtree_lss.onboard.config.vehicle import Lengths, VehicleConfig


@contextlib.contextmanager
def lengths(**own: float) -> Iterator[None]:
    """Replace lengths of the default vehicle while a configuration and a mapper are made.

    ``outlier_gate`` 0 keeps all returns; an infinite ``feature_height`` disables features.
    """
    with mock.patch.object(VehicleConfig, "lengths", dataclasses.replace(Lengths(), **own)):
        yield
