# SPDX-License-Identifier: Apache-2.0
"""Poses in TUM's form and in CSV."""

import numpy as np
import pytest

from quadtree_lss.desk.exchange.clouds import read_poses
from quadtree_lss.onboard.elevation.libraries import ExchangeError


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


def test_csv_without_a_header_has_the_order_of_tum(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("0.5,1,2,3,0,0,0,1\n")
    assert read_poses(path).stamp_ns.tolist() == [500000000]


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
