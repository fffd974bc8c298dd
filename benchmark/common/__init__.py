# SPDX-License-Identifier: Apache-2.0
"""Shared parts of the benchmarks: simulated flights, reference methods, scores and tables."""

from common.flights import Recording, configuration, data_folder, recording
from common.heights import mean_heights
from common.scores import MapScore, score
from common.tables import machine, table

__all__ = [
    "MapScore",
    "Recording",
    "configuration",
    "data_folder",
    "machine",
    "mean_heights",
    "recording",
    "score",
    "table",
]
