# SPDX-License-Identifier: Apache-2.0
"""Point clouds without a bag: the same map as of a bag with the same scans and poses."""

import json

import numpy as np
import pytest
from replay.recordings import write_ros2
from replay.test_cli import FAST, run
from scipy.spatial.transform import Rotation

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay, scans

PAIRS = (word.split("=") for word in FAST if "=" in word)
KEYS = {key: float(value) if "." in value else int(value) for key, value in PAIRS}
CONFIG = load_config((), KEYS)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A bag, and its scans with their poses."""
    bag = write_ros2(tmp_path_factory.mktemp("flight") / "bag", scans=6)
    return bag, list(scans(bag, CONFIG))


def seconds(stamp_ns):
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def tum(path, poses):
    lines = []
    for pose in poses:
        turn = Rotation.from_matrix(pose.rotation_map_lidar).as_quat()
        numbers = " ".join(f"{v:.17g}" for v in (*pose.position, *turn))
        lines.append(f"{seconds(pose.stamp_ns)} {numbers}\n")
    path.write_text("".join(lines))
    return path


def clouds_and_poses(folder, seen, name=lambda k, scan: f"{scan.stamp_ns}.npy", poses=6):
    (folder / "clouds").mkdir()
    for number, scan in enumerate(seen):
        np.save(folder / "clouds" / name(number, scan), scan.points_lidar)
    return folder / "clouds", tum(folder / "poses.tum", [scan.pose for scan in seen[:poses]])


def same(one, other, most=1e-6):
    np.testing.assert_array_equal(one.level, other.level)
    np.testing.assert_allclose(one.z, other.z, atol=most)


@pytest.mark.parametrize(
    "name",
    [
        lambda k, s: f"scan_{s.stamp_ns}.npy",
        lambda k, s: f"{seconds(s.stamp_ns)}.npy",
        lambda k, s: f"{s.stamp_ns + (-1) ** k * 400}.npy",  # of poses in whole microseconds
        lambda k, s: f"cloud{k}.npy",
    ],
)
def test_clouds_with_poses_give_the_map_of_the_bag(flight, tmp_path, name):
    bag, seen = flight
    clouds, poses = clouds_and_poses(tmp_path, seen, name)
    np.savez(clouds / "truth.npz", elevation=np.zeros(3))  # no cloud: of a simulation
    # Poses of text say nothing of their covariance.
    unknown = {"pose.unknown_position_sigma": 0.01, "pose.unknown_attitude_sigma_deg": 0.00573}
    config = load_config((), KEYS | unknown)
    of_bag = replay(bag, None, config)
    of_files = replay(clouds, None, config, poses=poses)
    assert [r.stamp_ns for r in of_files.timings] == [r.stamp_ns for r in of_bag.timings]
    same(of_files.cells, of_bag.cells)
    assert not of_files.losses


def test_stamps_of_a_file_and_poses_between(flight, tmp_path):
    bag, seen = flight
    stamps = np.array([scan.stamp_ns for scan in seen])
    points = np.stack([scan.points_lidar for scan in seen])
    np.savez(tmp_path / "scans.npz", points=points, stamp_ns=stamps)
    ends = [scan.pose for scan in (seen[0], seen[-1])]  # a straight line at one speed
    poses = tum(tmp_path / "poses.tum", ends)
    found = replay(tmp_path / "scans.npz", None, CONFIG, poses=poses)
    assert found.summary["scans"] == 6
    same(found.cells, replay(bag, None, CONFIG).cells, 1e-3)  # text: of unknown covariance


def test_a_cloud_in_the_map_frame_needs_no_poses(flight, tmp_path):
    _, seen = flight
    points = [
        s.points_lidar.reshape(-1, 3) @ s.pose.rotation_map_lidar.T + s.pose.position for s in seen
    ]
    np.save(tmp_path / "survey.npy", np.concatenate(points))
    found = replay(tmp_path / "survey.npy", None, CONFIG)
    ground = found.cells.at([0.0, 4.0, -4.0], [0.0, 3.0, -2.0])
    np.testing.assert_allclose(ground.height, [0.0, 0.2, -0.2], atol=0.05)
    assert any("map's frame" in line for line in found.warnings)


def test_a_damaged_cloud_is_a_loss(flight, tmp_path, capsys):
    _, seen = flight
    clouds, poses = clouds_and_poses(tmp_path, seen)
    broken = sorted(clouds.iterdir())[2]
    broken.write_bytes(broken.read_bytes()[:40])
    out = tmp_path / "out"
    code, shown, err = run(capsys, "replay", clouds, "--poses", poses, "--out", out, *FAST)
    assert code == 3 and "5 scans mapped" in shown and broken.name in err


@pytest.mark.slow
def test_info_and_suggest_read_clouds_too(flight, tmp_path, capsys):
    _, seen = flight
    clouds, poses = clouds_and_poses(tmp_path, seen)
    code, out, _ = run(capsys, "info", clouds, "--poses", poses)
    assert code == 0 and "6 scans have a pose" in out and "ready to replay" in out
    code, out, _ = run(capsys, "doctor", clouds, "--poses", poses)
    assert code == 0 and out.startswith("note:  pose_covariance_unknown")  # TUM has none
    code, out, _ = run(capsys, "doctor", clouds)  # whose poses are made up
    assert code == 0 and "wrong:" not in out and "note:  no --poses: " in out
    code, out, _ = run(capsys, "config", "suggest", clouds, "--poses", poses, "--json")
    assert code == 0 and json.loads(out)["values"]["lidar.range_noise"] > 0.01
