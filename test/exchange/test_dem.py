# SPDX-License-Identifier: Apache-2.0
"""Elevation models from NPZ and GeoTIFF."""

import numpy as np
import pytest

from quadtree_lss.desk.exchange.dem import read_dem
from quadtree_lss.desk.exchange.formats import ExchangeError

X, Y = 500_000.0 + 2.0 * np.arange(7), 4_000_000.0 + 2.0 * np.arange(5)
Z = np.round(np.random.default_rng(1).uniform(0.0, 9.0, (5, 7)), 2)


def band(path, values=Z, crs="EPSG:32611", unit=None, scale=1.0, offset=0.0, bands=1, **shape):
    """A raster, north first, whose band says how its numbers are heights."""
    rasterio = pytest.importorskip("rasterio")
    grid = rasterio.Affine(2.0, 0.0, X[0] - 1.0, 0.0, -2.0, Y[-1] + 1.0)
    shape = {"width": 7, "height": 5, "count": bands, "dtype": "float64"} | shape
    shape = {"driver": "GTiff", "crs": crs, "transform": grid} | shape
    with rasterio.open(path, "w", **shape) as file:
        file.scales, file.offsets = [scale] * bands, [offset] * bands
        if unit:
            file.units = [unit] * bands
        for k in range(bands if values is not None else 0):
            file.write(values[::-1].astype(shape["dtype"]), k + 1)
    return path


def test_npz_and_geotiff_are_the_same_ground(tmp_path):
    np.savez(tmp_path / "dem.npz", x=X, y=Y, elevation=Z)
    expected = Z.copy()
    expected[-1, 0] = np.nan  # the north-western post
    told = np.nan_to_num(expected, nan=-9999.0)
    path = band(tmp_path / "dem.tif", told, dtype="float32", nodata=-9999.0)
    one, other = read_dem(tmp_path / "dem.npz"), read_dem(path)
    np.testing.assert_array_equal(one.elevation, Z)
    for name in "xy":
        np.testing.assert_allclose(getattr(other, name), getattr(one, name))
    np.testing.assert_allclose(other.elevation, expected, atol=1e-6)
    assert one.spacing == other.spacing == 2.0 and "32611" in other.crs and not one.crs
    part = one.within(np.array([X[1], Y[2]]), np.array([X[3], Y[4]]))
    np.testing.assert_array_equal(part.elevation, Z[2:5, 1:4])


@pytest.mark.parametrize(
    ("crs", "turned", "word"),
    [
        ("EPSG:4326", False, "degrees"),
        ("EPSG:2225", False, "foot"),
        ("EPSG:32611", True, "north up"),
    ],
)
def test_what_is_not_metric_or_turned_is_told(tmp_path, crs, turned, word):
    rasterio = pytest.importorskip("rasterio")
    options = {"transform": rasterio.Affine(2, 1, 0, 0, -2, 0)} if turned else {}
    with pytest.raises(ExchangeError, match=word):
        read_dem(band(tmp_path / "dem.tif", crs=crs, **options))


@pytest.mark.parametrize(
    ("crs", "unit", "metres"),
    [
        ("EPSG:32611", "km", 1000.0),
        ("EPSG:32611", "ft", 0.3048),
        ("EPSG:26911+5703", None, 1.0),
        ("EPSG:26911+6360", None, 1200.0 / 3937.0),  # told by the vertical system alone
    ],
)
def test_heights_are_what_the_band_says(tmp_path, crs, unit, metres):
    path = band(tmp_path / "dem.tif", crs=crs, unit=unit, scale=10.0, offset=-3.0)
    np.testing.assert_allclose(read_dem(path).elevation, metres * (10.0 * Z - 3.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ({"unit": "fathom"}, "'fathom', which is not a known unit"),
        ({"bands": 3, "dtype": "uint8"}, "bands of red, green, blue"),
        ({"bands": 2}, "gray, "),
        ({"dtype": "complex64"}, "complex64"),
        ({"width": 200_000, "height": 90_000, "values": None, "sparse_ok": True}, "is the most"),
        ({"values": np.where(Z > 5.0, -3.4e6, Z)}, "declare the value that means no data"),
        ({"crs": 'LOCAL_CS["site",UNIT["foot",0.3048]]'}, "units of foot"),
    ],
)
def test_what_is_no_ground_in_metres_is_refused(tmp_path, how, word):
    with pytest.raises(ExchangeError, match=word):
        read_dem(band(tmp_path / "dem.tif", **how))


@pytest.mark.parametrize(
    ("arrays", "word"),
    [
        ({"x": X, "y": Y}, "arrays x, y and elevation"),
        ({"x": X, "y": Y, "elevation": Z + 1j}, "real numbers"),
        ({"x": X, "y": Y, "elevation": Z.T}, "does not match"),
        ({"x": X[::-1], "y": Y, "elevation": Z}, "equal steps"),
        ({"x": X**2, "y": Y, "elevation": Z}, "equal steps"),
        ({"x": X, "y": Y, "elevation": np.full_like(Z, np.nan)}, "too few"),
    ],
)
def test_other_arrays_are_no_elevation_model(tmp_path, arrays, word):
    np.savez(tmp_path / "dem.npz", **arrays)
    with pytest.raises(ExchangeError, match=word):
        read_dem(tmp_path / "dem.npz")


def test_other_files_are_no_elevation_model(tmp_path):
    pytest.importorskip("rasterio")
    for name, word in (("dem.npz", "cannot be read"), ("dem.tif", "cannot be read")):
        (tmp_path / name).write_bytes(b"nonsense")
        with pytest.raises(ExchangeError, match=word):
            read_dem(tmp_path / name)
    (tmp_path / "dem.txt").write_text("1 2 3")
    with pytest.raises(ExchangeError, match="not an elevation model"):
        read_dem(tmp_path / "dem.txt")
    with pytest.raises(ExchangeError, match="no such file"):
        read_dem(tmp_path / "none.tif")


@pytest.mark.parametrize("nothing", [-9999.0, -32768.0, 3.4028234663852886e38, -1.7e308])
@pytest.mark.parametrize("kind", ["npz", "tif"])
def test_values_that_are_no_data_without_saying_so_are_no_ground(tmp_path, kind, nothing):
    values, path = Z.copy(), tmp_path / f"dem.{kind}"
    values[1, 2] = nothing
    if kind == "npz":
        np.savez(path, x=X, y=Y, elevation=values)
    else:
        band(path, values)
    heights = read_dem(path).elevation
    assert np.isnan(heights[1, 2]) and np.isfinite(heights).sum() == Z.size - 1


def test_a_file_is_read_by_the_drivers_of_elevation_models_alone(tmp_path):
    """A virtual raster opens what it names: other files, pipes, addresses."""
    source = band(tmp_path / "real.tif")
    virtual = f"""<VRTDataset rasterXSize="7" rasterYSize="5"><VRTRasterBand dataType="Float64"
      band="1"><SimpleSource><SourceFilename>{source}</SourceFilename><SourceBand>1</SourceBand>
      </SimpleSource></VRTRasterBand></VRTDataset>"""
    service = """<GDAL_WMS><Service name="TMS"><ServerUrl>http://127.0.0.1:9/${x}</ServerUrl>
      </Service></GDAL_WMS>"""
    for text in (virtual, service):
        (tmp_path / "dem.tif").write_text(text)
        with pytest.raises(ExchangeError, match="cannot be read"):
            read_dem(tmp_path / "dem.tif")
