# SPDX-License-Identifier: Apache-2.0
"""Files through their readers to what works with them: each is taken soundly or refused in a line.

A case is a good file of which a part is spoilt, or its bytes. Counters are closed: taken and
refused by reason are as many as were sent.
"""

from __future__ import annotations

import io
import os
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from exchange.test_dem import band
from fuzz.cases import NUMBERS, damaged, one_of
from replay.recordings import GROUND

from quadtree_lss.desk.replay.elevation_model import rank_sites
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.errors import QuadtreeLssError

#: Cases of each kind of file, and how many times as many the slow test sends. Damaged bags are
#: those of replay/test_damaged_bags.py.
COUNTS = {"dem_npz": 50, "dem_tiff": 50}
SEED, MANY = int(os.environ.get("FUZZ_SEED", "7110")), 30
TYPES = ["f2", "f4", "f8", ">f8", "i1", "u2", "i8", "u8", "c16", "?", "S3", "U2", "M8[ns]"]
CONFIG = config_from_values({**GROUND, "lss.grid_spacing": 1.0, "lss.sites": 2})
AXIS = np.linspace(-12.0, 12.0, 13)
HEIGHTS = 0.1 * AXIS + 0.02 * AXIS[:, None] ** 2


def spoilt_bytes(rng, content):
    """One time in three some bytes are others, a piece is gone, or twice there."""
    for _ in range(int(rng.integers(1, 4)) if rng.random() < 0.35 and content else 0):
        content = damaged(content, rng) or content
    return content


@np.errstate(all="ignore")
def spoilt_array(rng, array):
    array = np.array(array)
    for _ in range(int(one_of(rng, [0, 0, 1, 2]))):
        how = rng.integers(5)
        if how == 0 and array.size and array.dtype.kind in "fiu":
            place = rng.integers(array.size)
            array.reshape(-1)[place] = np.float64(one_of(rng, NUMBERS)).astype(array.dtype)
        elif how == 1 and array.dtype.kind in "fiu":
            array = array * np.float64(one_of(rng, NUMBERS))
        elif how == 2 and array.dtype.kind in "fiu":
            array = array.astype(one_of(rng, TYPES))
        elif how == 3:
            array = one_of(rng, [array[:0], array[:1], array[None], array.T, array[..., :2]])
        elif array.dtype.kind == "f":
            array = array + one_of(rng, NUMBERS)
    return array


def archive(rng, arrays):
    out = io.BytesIO()
    arrays = {name: spoilt_array(rng, a) for name, a in arrays.items() if rng.random() > 0.02}
    np.savez_compressed(out, **arrays)
    return spoilt_bytes(rng, out.getvalue())


def sound(result):
    """What came of a file that was taken."""
    sites = result.assessment.sites
    assert np.isfinite(sites.position).all() and np.isfinite(sites.score).all()
    result.as_dict()


def dem_npz(rng, folder):
    path = folder / "dem.npz"
    path.write_bytes(archive(rng, {"x": AXIS, "y": AXIS, "elevation": HEIGHTS}))
    sound(rank_sites(path, None, CONFIG))


def dem_tiff(rng, folder):
    rasterio = pytest.importorskip("rasterio")
    path = folder / "dem.tif"
    path.unlink(missing_ok=True)
    step, scale = (float(one_of(rng, [*[usual] * 40, *NUMBERS])) for usual in (2.0, 1.0))
    with np.errstate(all="ignore"):
        values = spoilt_array(rng, HEIGHTS)
        values = HEIGHTS if values.shape != HEIGHTS.shape else values
        kind = one_of(rng, ["float32", "float64", "int16", "uint8", "complex64"])
        how = {"dtype": kind, "bands": int(one_of(rng, [1, 1, 1, 1, 2, 3])), "scale": scale}
        how |= {"crs": one_of(rng, [None, "EPSG:32611", "EPSG:32611", "EPSG:4326", "EPSG:2225"])}
        how |= {"transform": rasterio.Affine(step, 0.0, -12.0, 0.0, -step, 12.0)}
        how |= {"unit": one_of(rng, ["", "", "m", "ft", "km", "deg", "1", "\u202e"])}
        how |= {"offset": float(one_of(rng, [*[0.0] * 40, 0.1, *NUMBERS]))}
        try:
            band(path, values, width=13, height=13, **how)
        except (rasterio.errors.RasterioError, ValueError, TypeError, OverflowError):
            return  # what GDAL does not write
    path.write_bytes(spoilt_bytes(rng, path.read_bytes()))
    sound(rank_sites(path, None, CONFIG))


KINDS = {f.__name__: f for f in (dem_npz, dem_tiff)}


def through(kind: str, folder: Path, seed: int, count: int) -> Counter[str]:
    told: Counter[str] = Counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k in range(count):
            try:
                KINDS[kind](np.random.default_rng([seed, k]), folder)
                told["taken"] += 1
            except QuadtreeLssError as error:
                assert str(error).isprintable() and len(str(error)) < 1100
                told[type(error).__name__] += 1
            except Exception as error:
                msg = f"{kind}: case {k} of seed {seed}"
                raise AssertionError(msg) from error
    assert told.total() == count
    return told


@pytest.mark.parametrize("kind", KINDS)
def test_every_file_is_taken_soundly_or_refused_in_a_line(kind, tmp_path):
    told = through(kind, tmp_path, SEED, COUNTS[kind])
    assert told["taken"] and told.total() > told["taken"], told


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_more(kind, tmp_path):
    through(kind, tmp_path, SEED + 1, MANY * COUNTS[kind])
