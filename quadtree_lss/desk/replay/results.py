# SPDX-License-Identifier: Apache-2.0
"""The files of a results folder: names, keys and units other tools rely on.

Each file is written beside its place and then moved there, so that a reader never sees half of
one and a failed run leaves the files of the last.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import tempfile
import time
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.replay.passes import TargetChange
from quadtree_lss.onboard.core.landing.sites import LandingAssessment
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.maps import known_probability

SITE_COLUMNS = (
    "rank",
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    "score",
    "slope_deg",
    "roughness",
    "hazard_distance",
    "subscale_height",
    "id",
    "probability",
)


REPORT = "report.html"
FIGURES = ("elevation", "slope", "hazards", "probability", "score", "timing")
"""Names of the figures, ``figures/<name>.png``, in the order of the page."""

SAMPLE, WORTH_PACKING = 1 << 14, 0.85
"""An array is packed if so many bytes from its middle come down to less than this share."""


class ScanTiming(NamedTuple):
    """A row of ``timing.csv``; ``map_ms`` is from the decoded message to the divided map."""

    stamp_ns: int
    points: int
    points_used: int
    leaves: int
    divisions: int
    map_ms: float


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file beside ``path`` and moves it there; makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def new_folder(root: Path) -> Path:
    """An unused name ``root/<date>_<time>``; the folder is not made."""
    name = time.strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ("", *(f"_{n}" for n in range(2, 1000))):
        if not (root / f"{name}{suffix}").exists():
            return root / f"{name}{suffix}"
    msg = f"{root}: a thousand results of one second"
    raise OSError(msg)


def link_latest(folder: Path) -> Path | None:
    """Lets ``latest`` beside ``folder`` point at it; None where that cannot be: it is no link."""
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return None
    fresh = folder.parent / f".latest.{os.getpid()}"
    try:
        fresh.symlink_to(folder.name, target_is_directory=True)
        os.replace(fresh, link)
    except OSError:  # a file system without links
        fresh.unlink(missing_ok=True)
        return None
    return link


def remove_report(out: Path) -> None:
    """Takes away page, figures and evaluation of an earlier run, which would contradict this one.

    Of the folder ``evaluation`` those files go that `evaluate` writes.
    """
    (out / REPORT).unlink(missing_ok=True)
    for name in FIGURES:
        (out / "figures" / f"{name}.png").unlink(missing_ok=True)
    folder = out / "evaluation"
    for path in (*folder.glob("fig[0-9][0-9]_*.png"), folder / "evaluation.json", folder / REPORT):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not there, or somebody else's files in it
        folder.rmdir()


def write_sites(path: Path, assessment: LandingAssessment) -> None:
    """``sites.csv``: ranked sites, best first; map frame, m."""
    sites = assessment.sites
    columns = np.column_stack(
        [
            sites.position,
            sites.normal,
            sites.score,
            sites.slope_deg,
            sites.roughness,
            sites.hazard_distance,
            sites.subscale_height,
        ]
    )
    rows = (
        [rank, *map(float, row), int(number), float(probability)]
        for rank, (row, number, probability) in enumerate(
            zip(columns, sites.id, sites.probability, strict=True), start=1
        )
    )
    _write_csv(path, SITE_COLUMNS, rows)


def write_selected(path: Path, changes: Iterable[TargetChange]) -> None:
    """``selected.csv``: one row per change of the target; map frame, m."""
    _write_csv(path, TargetChange._fields, changes)


def write_timing(path: Path, timings: Iterable[ScanTiming]) -> None:
    """``timing.csv``: one row per mapped scan."""
    rows = ([*row[:-1], f"{row.map_ms:.4f}"] for row in timings)
    _write_csv(path, ScanTiming._fields, rows)


def write_cells(path: Path, cells: CellMap) -> None:
    """``cells.npz``, see `cells_arrays`."""
    _write_npz(path, cells_arrays(cells))


def cells_arrays(cells: CellMap) -> dict[str, NDArray[Any]]:
    """Content of ``cells.npz``: one array per field of the leaves, in Morton order."""
    domain = cells.domain
    return {
        "level": cells.level,
        "ix": cells.ix,
        "iy": cells.iy,
        "x": cells.x,
        "y": cells.y,
        "size": cells.size,
        "z": cells.z,
        "nx": cells.normal[:, 0],
        "ny": cells.normal[:, 1],
        "nz": cells.normal[:, 2],
        "covariance": cells.covariance,
        "covariance_pose": cells.covariance_pose,
        "count": cells.count,
        "measured": cells.measured,
        "roughness": cells.roughness,
        "exception_fraction": cells.exception_fraction,
        "feature": cells.feature,
        "observed": np.bincount(cells.leaf_raster()[cells.observed], minlength=len(cells.z)),
        "observed_cells": cells.observed,
        "domain": np.array(
            [domain.xmin, domain.ymin, domain.size, domain.min_level, domain.max_level]
        ),
        "stamp_ns": np.array(cells.stamp_ns),
        "offset": np.array([cells.offset_z, cells.offset_variance]),
        "low": cells.low,
        "high": cells.high,
        "known_cells": cells.known,
    }


def write_grid(path: Path, assessment: LandingAssessment) -> None:
    """``grid.npz``, see `grid_arrays`."""
    _write_npz(path, grid_arrays(assessment))


def grid_arrays(assessment: LandingAssessment) -> dict[str, NDArray[Any]]:
    """Content of ``grid.npz``: the landing grid's points, arrays (ny, nx)."""
    return {
        "x": assessment.x,
        "y": assessment.y,
        "elevation": assessment.elevation,
        "plane_elevation": assessment.plane_elevation,
        "slope_deg": assessment.slope_deg,
        "hazard": assessment.hazard,
        "safe": assessment.safe,
        "score": assessment.score,
        "probability": known_probability(assessment),
        "risk": assessment.risk,
    }


def write_history(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """``history.npz``: see `history.History.arrays`."""
    _write_npz(path, arrays)


def write_summary(path: Path, summary: Mapping[str, Any]) -> None:
    """``summary.json``; numbers that are not finite become null."""
    text = json.dumps(plain(summary), indent=2, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def plain(value: Any) -> Any:
    """The value with JSON's types alone; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _write_csv(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())


def _write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """As `numpy.savez_compressed` does, in a quarter of the time.

    What hardly packs, such as the last digits of an elevation, is stored as it is.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, values in arrays.items():
            array = io.BytesIO()
            np.lib.format.write_array(array, np.asanyarray(values), allow_pickle=False)
            data = array.getvalue()
            sample = data[len(data) // 2 :][:SAMPLE]
            packs = len(zlib.compress(sample, 1)) < WORTH_PACKING * len(sample)
            kind = zipfile.ZIP_DEFLATED if packs else zipfile.ZIP_STORED
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), data, kind, 1)
    write_bytes(path, content.getvalue())
