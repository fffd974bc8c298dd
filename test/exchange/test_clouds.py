# SPDX-License-Identifier: Apache-2.0
"""Point clouds of every format: what is written by its library comes back, and else one line; and
poses in TUM's form and in CSV."""

import re

import numpy as np
import pytest

from quadtree_lss.desk.exchange import clouds
from quadtree_lss.desk.exchange.clouds import READERS, read_clouds, read_poses
from quadtree_lss.desk.exchange.libraries import ExchangeError

POINTS = np.random.default_rng(5).uniform(-50.0, 50.0, (6, 4, 3)).round(3)


def write(path, points=POINTS):
    """A cloud by the library of its format."""
    flat = points.reshape(-1, 3)
    if path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".npz":
        np.savez(path, points=points)
    elif path.suffix == ".ply":
        pytest.importorskip("trimesh").PointCloud(flat).export(path)
    else:
        module = pytest.importorskip("pypcd4")
        module.PointCloud.from_xyz_points(flat.astype(np.float32)).save(path)
    return path


@pytest.mark.parametrize("suffix", READERS)
def test_points_come_back(tmp_path, suffix):
    (found,), stamps = read_clouds(write(tmp_path / f"cloud{suffix}"))
    assert stamps is None and found.shape[-1] == 3
    np.testing.assert_allclose(found.reshape(-1, 3), POINTS.reshape(-1, 3), atol=1e-5)
    assert (found.shape == POINTS.shape) == (suffix in (".npy", ".npz"))


def test_several_scans_in_one_file(tmp_path):
    scans = np.stack([POINTS, POINTS + 1.0])
    np.savez(tmp_path / "scans.npz", points=scans, stamp_ns=np.array([5, 7]))
    found, stamps = read_clouds(tmp_path / "scans.npz")
    assert stamps.tolist() == [5, 7]
    np.testing.assert_array_equal(found, scans)
    for wrong in ([5, 7, 9], [[5, 6], [7, 8]]):
        np.savez(tmp_path / "wrong.npz", points=scans, stamp_ns=np.array(wrong))
        with pytest.raises(ExchangeError, match=re.escape(str(np.shape(wrong)))):
            read_clouds(tmp_path / "wrong.npz")


def test_a_large_cloud_becomes_several_scans(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "MOST_POINTS", 10)
    found, _ = read_clouds(write(tmp_path / "large.npy"))
    assert [len(part) for part in found] == [10, 10, 4]
    np.testing.assert_array_equal(np.concatenate(found), POINTS.reshape(-1, 3))


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("content", [b"", b"nonsense\n", b"ply\n\x00\xff"])
def test_what_is_no_cloud_is_one_line(tmp_path, suffix, content):
    pytest.importorskip({".ply": "trimesh", ".pcd": "pypcd4"}.get(suffix, "numpy"))
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(content)
    with pytest.raises(ExchangeError, match="bad") as told:
        read_clouds(path)
    assert "\n" not in str(told.value)


def test_tum_keeps_nanoseconds_and_sorts(tmp_path):
    path = tmp_path / "poses.tum"
    text = "# stamp x y z qx qy qz qw\n1700000000.123456789 1 2 3 0 0 0 1\n\n"
    path.write_text(text + "1700000000.023456789 4 5 6 1 0 0 0\n")
    found = read_poses(path)
    assert found.stamp_ns.tolist() == [1700000000023456789, 1700000000123456789]
    np.testing.assert_array_equal(found.position, [[4, 5, 6], [1, 2, 3]])
    np.testing.assert_array_equal(found.xyzw, [[1, 0, 0, 0], [0, 0, 0, 1]])
    assert not found.covariance.any()


def test_csv_goes_by_names(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("qw,stamp_ns,x,y,z,qx,qy,qz,note\n1,1700000000123456789,1,2,3,0,0,0,good\n")
    found = read_poses(path)
    assert found.stamp_ns.tolist() == [1700000000123456789]
    np.testing.assert_array_equal(found.xyzw, [[0, 0, 0, 1]])
    names = ",".join(f"cov_{k}" for k in range(36))
    values = ",".join(str(k) for k in range(36))
    path.write_text(f"stamp,x,y,z,qx,qy,qz,qw,{names}\n2.5,1,2,3,0,0,0,1,{values}\n")
    found = read_poses(path)
    assert found.stamp_ns.tolist() == [2500000000]
    np.testing.assert_array_equal(found.covariance, [np.arange(36.0)])


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "no pose"),
        (b"# nothing\n", "no pose"),
        (b"stamp_ns,x,y,z,qx,qy,qz,qw\n", "no pose"),
        (b"stamp_ns,x,y,qx,qy,qz,qw\n1,1,1,1,1,1,1\n", "lacks z"),
        (b"x,y,z,qx,qy,qz,qw\n1,1,1,1,1,1,1\n", "lacks stamp_ns"),
        (b"1 2 3\n", "pose 1 is not a row of numbers: 1 2 3"),
        (b"1 2 3 4 0 0 0 one\n", "pose 1"),
        (b"\xff\xfe\x00", "not text"),
    ],
)
def test_what_is_no_file_of_poses_is_one_line(tmp_path, content, word):
    path = tmp_path / "poses.txt"
    path.write_bytes(content)
    with pytest.raises(ExchangeError, match=word):
        read_poses(path)
    with pytest.raises(ExchangeError, match="cannot be read"):
        read_poses(tmp_path / "none")
