# SPDX-License-Identifier: Apache-2.0
"""Bags and truth files as a reader finds them."""

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from quadtree_lss.lab.simulation.simulate import simulate
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain

STORE = get_typestore(Stores.ROS2_JAZZY)


def _read(path):
    """Messages in the order of the bag: (topic, receive time, stamp, message)."""
    rows = []
    with Reader(path) as reader:
        for connection, received, raw in reader.messages():
            message = STORE.deserialize_cdr(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            rows.append((connection.topic, received, stamp, message))
    return rows


def _places(rows, truth, k):
    """(128, 128, 3) points of a scan, map frame, from its true pose."""
    cloud = [row[3] for row in rows if row[0] == "/lidar/points"][k]
    points = cloud.data.view("<f4").reshape(cloud.height, cloud.width, 3).astype(float)
    rotation = Rotation.from_quat(truth["scan_quaternion_xyzw"][k]).as_matrix()
    return points @ rotation.T + truth["scan_position"][k]


@pytest.fixture(scope="module")
def hill():
    axis = np.linspace(-20.0, 20.0, 201)
    return Terrain(axis, axis, np.exp(-(axis[None, :] ** 2 + axis[:, None] ** 2) / 50.0))


@pytest.fixture(scope="module")
def morpheus(tmp_path_factory, hill):
    path = tmp_path_factory.mktemp("morpheus") / "bag"
    result = simulate("morpheus", path, seed=5, duration=1.0, terrain=hill)
    return result, _read(path), np.load(result.truth_path)


def test_messages_look_like_a_recording(morpheus):
    result, rows, truth = morpheus
    assert {topic for topic, *_ in rows} == {"/lidar/points", "/nav/pose"}
    received = [row[1] for row in rows]
    assert received == sorted(received)
    assert all(row[1] > row[2] for row in rows)
    clouds = [row for row in rows if row[0] == "/lidar/points"]
    poses = [row for row in rows if row[0] == "/nav/pose"]
    assert (len(clouds), len(poses)) == (result.scans, result.poses) and result.scans == 20
    stamps, pose_stamps = [row[2] for row in clouds], [row[2] for row in poses]
    np.testing.assert_array_equal(stamps, truth["scan_stamp_ns"])
    assert not set(pose_stamps) & set(stamps)
    assert pose_stamps[0] < stamps[0] and stamps[-1] < pose_stamps[-1]
    message = clouds[0][3]
    assert message.header.frame_id == "lidar"
    assert (message.height, message.width, message.point_step) == (128, 128, 12)
    assert [field.name for field in message.fields] == ["x", "y", "z"]
    assert poses[0][3].header.frame_id == "map"


def test_points_lie_on_the_terrain_seen_from_the_true_pose(morpheus, hill):
    points = np.stack([_places(*morpheus[1:], k) for k in (0, 10, 19)])
    error = points[..., 2] - hill.elevation_at(points[..., 0], points[..., 1])
    error = error[np.isfinite(error)]
    assert abs(error.mean()) < 2e-3
    # 6 cm along a ray at 30° are 3 cm of height; slopes add a little.
    assert error.std() == pytest.approx(0.03, rel=0.15)


def test_poses_are_near_the_truth_as_their_covariance_says(morpheus):
    _, rows, truth = morpheus
    poses = [row[3].pose for row in rows if row[0] == "/nav/pose"]
    stamps = np.array([row[2] for row in rows if row[0] == "/nav/pose"])
    positions = np.array([[getattr(p.pose.position, c) for c in "xyz"] for p in poses])
    between = np.column_stack(
        [np.interp(truth["scan_stamp_ns"], stamps, positions[:, k]) for k in range(3)]
    )
    covariance = poses[0].covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance, covariance.T)
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    sigma = np.sqrt(np.diag(covariance)[:3])
    assert np.all(np.abs(between - truth["scan_position"]) < 4.0 * sigma)
    for pose in poses:
        q = pose.pose.orientation
        assert np.hypot(np.hypot(q.x, q.y), np.hypot(q.z, q.w)) == pytest.approx(1.0)


def test_truth_has_the_agreed_arrays(morpheus):
    result, _, truth = morpheus
    assert set(truth) == {
        "x", "y", "elevation", "safe_x", "safe_y", "safe", "box",
        "scan_stamp_ns", "scan_position", "scan_quaternion_xyzw", "seed", "lander",
    }  # fmt: skip
    assert int(truth["seed"]) == 5
    assert truth["elevation"].shape == (truth["y"].size, truth["x"].size)
    assert truth["safe"].shape == (truth["safe_y"].size, truth["safe_x"].size)
    xmin, xmax, ymin, ymax = truth["box"]
    assert (truth["safe_x"][0], truth["safe_x"][-1]) == (xmin, xmax)
    assert (truth["safe_y"][0], truth["safe_y"][-1]) == (ymin, ymax)
    np.testing.assert_allclose(np.diff(truth["safe_x"]), 0.25)
    assert truth["safe"].dtype == bool


def test_same_seed_same_messages(tmp_path, hill):
    options = {"duration": 1.0, "terrain": hill}
    bags = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulate("descent", tmp_path / name / "bag", seed=seed, **options)
        with Reader(tmp_path / name / "bag") as reader:
            bags.append([(received, bytes(raw)) for _, received, raw in reader.messages()])
    assert bags[0] == bags[1]
    assert bags[0] != bags[2]


@pytest.mark.parametrize(
    "options",
    [
        {"scenario": "marsrover"},
        {"duration": 0.0},
        {"duration": float("nan")},
        {"outliers": 1.5},
        {"dropouts": "many"},
        {"range_noise": -1.0},
        {"flights": 0},
        {"seed": -1},
        {"terrain": "nowhere.npz"},
        {"scenario": "depth", "range_noise": 0.1},
    ],
)
def test_options_that_make_no_sense(tmp_path, options):
    arguments = {"scenario": "descent", "seed": 1, **options}
    with pytest.raises(SimulationError) as caught:
        simulate(bag_path=tmp_path / "bag", **arguments)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "bag").exists()


def test_flights_follow_one_another(tmp_path, hill):
    result = simulate("descent", tmp_path / "bag", seed=1, duration=1.0, terrain=hill, flights=2)
    truth = np.load(result.truth_path)
    assert np.all(np.diff(truth["scan_stamp_ns"]) > 0)
    np.testing.assert_allclose(truth["scan_position"][:5], truth["scan_position"][5:])
    rows = _read(tmp_path / "bag")
    poses = [row[3].pose.pose.position.x for row in rows if "nav" in row[0]]
    assert poses[0] != poses[len(poses) // 2]  # with other errors
    assert str(result.truth_path) in result.table()
