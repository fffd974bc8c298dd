# SPDX-License-Identifier: Apache-2.0
"""Faults of integrators, each made from one good flight and found with its fix."""

import dataclasses
import json
from dataclasses import dataclass, field

import numpy as np
import pytest
from replay.recordings import CLOUD, POSE, SECOND, START, recording, write_ros2
from replay.test_cli import run
from scipy.spatial.transform import Rotation

from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.onboard.config.settings import config_from_values

DOMAIN = {"xmin": -30.0, "ymin": -30.0, "size": 60.0, "min_level": 3, "max_level": 7}
BASE = {"domain": DOMAIN, "lidar.range_noise": 0.02}
DOWN = Rotation.from_euler("x", 180.0, degrees=True)
OPTICAL_FLU = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # takes FLU to optical
NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def height(x, y):
    """Gentle ground without a slope on the whole."""
    return 0.4 * np.sin(0.9 * x + 0.3 * y) + 0.3 * np.cos(0.5 * x - 1.1 * y)


def body(t):
    """Place and attitude (forward, left, up) of a drone that turns, sways and comes down."""
    place = np.stack([4.0 * np.sin(0.9 * t), 3.0 * np.cos(0.7 * t), 24.0 - 1.0 * t], axis=-1)
    angles = np.stack([8.0 * np.sin(2.1 * t), 6.0 * np.sin(1.7 * t + 1.0), 25.0 * t], axis=-1)
    return place, Rotation.from_euler("xyz", angles, degrees=True)


def rays():
    """Of a lidar of 60 x 45 degrees, z boresight."""
    right, down = np.meshgrid(np.linspace(-0.57, 0.57, 32), np.linspace(-0.41, 0.41, 24))
    return np.stack([right, down, np.ones_like(right)], axis=-1)


@dataclass
class Good:
    """A good flight: stamps by one clock, the body's poses, a lidar that looks straight down.

    A mistake changes its parts: times are s.
    """

    scan_times: np.ndarray = field(default_factory=lambda: np.arange(0.6, 7.4, 0.1))
    pose_times: np.ndarray = field(default_factory=lambda: np.arange(0.0, 8.0, 0.02))
    mount: Rotation = DOWN
    scale: float = 1.0
    scan_clock: float = 0.0
    pose_clock: float = 0.0
    covariance: np.ndarray = field(default_factory=lambda: np.diag([1e-4] * 3 + [1e-7] * 3))
    frame: str = "map"
    place: object = staticmethod(lambda place, turn: place)
    quaternion: object = staticmethod(lambda place, turn: turn.as_quat())
    cloud: object = staticmethod(lambda points, place, turn: points)
    of_lidar: bool = False
    sweep: float = 0.0  # from the first return of a scan to its last, each with its time
    again: float | None = None  # after this time each cloud is sent again, stamped then
    others: object = staticmethod(lambda recorder: None)  # writes other messages

    def write(self, path):
        rng = np.random.default_rng(70011)
        with recording(path) as recorder:
            for t in self.pose_times:
                place, turn = body(t)
                turn = turn * self.mount if self.of_lidar else turn
                at = START + round(t * SECOND)
                stamp = at + round(self.pose_clock * SECOND)
                quaternion = self.quaternion(place, turn)
                message = recorder.pose(stamp, self.place(place, turn), quaternion, self.frame)
                message.pose.covariance = self.covariance.reshape(-1)
                recorder.write("/nav/pose", message, POSE, at + 2_000_000)
            for t in self.scan_times:
                after = np.linspace(0.0, self.sweep, rays().size // 3)
                place, turn = body(t + after)
                turn = turn * self.mount
                direction = turn.apply(rays().reshape(-1, 3))
                reach = place[:, 2].copy()
                for _ in range(20):
                    x, y, z = (place + reach[:, None] * direction).T
                    reach += 0.8 * (height(x, y) - z) / direction[:, 2]
                points = reach[:, None] * rays().reshape(-1, 3)
                far = np.linalg.norm(points, axis=1, keepdims=True)
                points *= 1.0 + rng.normal(scale=0.02, size=far.shape) / far
                points = self.scale * self.cloud(points, place, turn)
                at = START + round(t * SECOND)
                stamp = at + round(self.scan_clock * SECOND)
                cloud = recorder.cloud(stamp, points.reshape(*rays().shape))
                if self.sweep:
                    fields = [*((name, "<f4") for name in "xyz"), ("t", "<u4")]
                    timed = np.empty(after.shape, fields)
                    timed["x"], timed["y"], timed["z"] = points.T
                    timed["t"] = np.rint(SECOND * after)
                    cloud = recorder.messages().cloud(timed, stamp)
                recorder.write("/lidar/points", cloud, CLOUD, at + 5_000_000)
                if self.again is not None:
                    cloud.header.stamp.nanosec += round(self.again * SECOND)
                    recorder.write("/lidar/points", cloud, CLOUD, at + 20_000_000)
            self.others(recorder)
        return path


LIDAR_POSES = {"of_lidar": True}
MOUNTED = {**BASE, "mount.roll_deg": 180.0}


def permuted(place, turn):
    return turn.as_quat()[[3, 0, 1, 2]]


#: Change of the flight, configuration, key of the finding and part of its fix.
FAULTS = {
    "poses in another frame": ({"frame": "odom"}, MOUNTED, "pose_frame", "frames.map: odom"),
    "NED poses of an FRD body": (
        {
            "place": lambda place, turn: NED.apply(place),
            "quaternion": lambda place, turn: (NED * turn * DOWN).as_quat(),
        },
        MOUNTED, "ned", "convert",
    ),
    "NED poses of the lidar": (
        {
            **LIDAR_POSES,
            "place": lambda place, turn: NED.apply(place),
            "quaternion": lambda place, turn: (NED * turn).as_quat(),
        },
        BASE, "ned", "convert",
    ),
    "w first": ({"quaternion": permuted}, MOUNTED, "quaternion", "x, y, z, w"),
    "w first, of the lidar": (
        {**LIDAR_POSES, "quaternion": permuted}, BASE, "quaternion", "x, y, z, w",
    ),
    "inverted orientations": (
        {**LIDAR_POSES, "quaternion": lambda place, turn: turn.inv().as_quat()},
        BASE, "inverse", "-x, -y, -z, w",
    ),
    "clouds FLU, poses optical": (
        {**LIDAR_POSES, "cloud": lambda points, place, turn: OPTICAL_FLU.inv().apply(points)},
        BASE, "axes", "mount.axes: flu_to_optical",
    ),
    "clouds optical, poses FLU": (
        {**LIDAR_POSES, "quaternion": lambda place, turn: (turn * OPTICAL_FLU).as_quat()},
        BASE, "axes", "mount.axes: optical_to_flu",
    ),
    "a forgotten mount": ({}, BASE, "mount", "roll_deg: 180"),
    "a mount too many": (LIDAR_POSES, MOUNTED, "mount", "remove"),
    "clouds in mm": ({"scale": 1000.0}, MOUNTED, "units", "0.001"),
    "clouds in cm": ({"scale": 100.0}, MOUNTED, "units", "0.01"),
    "poses in mm": (
        {"place": lambda place, turn: 1000.0 * place}, MOUNTED, "pose_units", "0.001",
    ),
    "clouds in the map": (
        {"cloud": lambda points, place, turn: turn.apply(points) + place},
        MOUNTED, "map_cloud", "--scan-topic",
    ),
    "clouds stamped since boot": ({"scan_clock": -1.7e9}, MOUNTED, "clocks", "lidar/points"),
    "poses stamped since boot": ({"pose_clock": -1.7e9}, MOUNTED, "clocks", "nav/pose"),
    "clouds of a clock 37 s ahead": ({"scan_clock": 37.0}, MOUNTED, "clocks", "37.0"),
    "poses that end before the first scan": (
        {"pose_times": np.array([0.98]), "scan_times": np.array([1.0])}, MOUNTED,
        "clocks", "until after the last",
    ),
    "clouds 0.2 s late": ({"scan_clock": 0.2}, MOUNTED, "lag", "-0.20 s"),
    "poses 0.12 s late": ({"pose_clock": 0.12}, MOUNTED, "lag", "+0.12 s"),
    "poses 0.12 s late, points with times": (
        {"pose_clock": 0.12, "sweep": 0.1}, MOUNTED, "lag", "+0.12 s",
    ),
    "a mount 9 deg off in roll": (
        {}, {**BASE, "mount.roll_deg": 171.0}, "mount_angle", "roll_deg: ",
    ),
    "a mount 4 deg off in pitch": (
        {}, {**MOUNTED, "mount.pitch_deg": -4.0}, "mount_angle", "pitch_deg: ",
    ),
    "poses once in two seconds": (
        {"pose_times": np.arange(0.0, 8.1, 2.0)}, MOUNTED, "rate", "raise the poses' rate",
    ),
    "an attitude that is hardly known": (
        {"covariance": np.diag([1e-4] * 3 + [1.0] * 3)}, MOUNTED, "pose_attitude", "covariance",
    ),
    "quaternions of zeros": (
        {"quaternion": lambda place, turn: np.zeros(4)}, MOUNTED, "pose_quaternion", "w: 1",
    ),
    "clouds that a relay stamps anew": ({"again": 0.01}, MOUNTED, "copies", "driver"),
    "a loop closure": (
        {"place": lambda place, turn: place + (place[2] < 20.0) * np.array([0.6, 0.0, 0.5])},
        MOUNTED, "jump", "--start",
    ),
    "a domain elsewhere": (
        {}, {**MOUNTED, "domain.xmin": 500.0}, "outside", "config suggest",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found_with_its_fix(name, tmp_path):
    change, values, key, fix = FAULTS[name]
    path = dataclasses.replace(Good(), **change).write(tmp_path / "bag")
    found = inspect_bag(path, config_from_values(values), diagnose=True).findings
    wrong = [finding for finding in found if finding.fix]
    assert [finding.key for finding in wrong] == [key], found
    assert fix in wrong[0].fix
    if key == "mount_angle":
        told = wrong[0].settings
        mount = Rotation.from_euler("xyz", list(told.values()), degrees=True)
        assert np.degrees((mount * DOWN.inv()).magnitude()) < 1.0


STILL = {"scan_times": np.full(60, 3.0) + 1e-3 * np.arange(60)}
GOOD = {
    "poses of the body": ({}, MOUNTED),
    "poses of the lidar": (LIDAR_POSES, BASE),
    "hardly any motion": (STILL, MOUNTED),
    "clocks since boot, both": ({"scan_clock": -1.7e9, "pose_clock": -1.7e9}, MOUNTED),
    "another noise": ({}, {**MOUNTED, "lidar.range_noise": 0.06}),
    "a time for each point": ({"sweep": 0.1}, MOUNTED),
    "covariances of nothing": ({"covariance": np.zeros((6, 6))}, MOUNTED),
    "an attitude that nobody knows": (
        {"covariance": np.diag([1e-4] * 3 + [1e6] * 3)}, MOUNTED,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_nothing_is_wrong_with_a_good_flight(name, tmp_path):
    change, values = GOOD[name]
    path = dataclasses.replace(Good(), **change).write(tmp_path / "bag")
    info = inspect_bag(path, config_from_values(values), diagnose=True)
    assert info.works and not [f for f in info.findings if f.fix], info.findings
    assert ("calm" in {f.key for f in info.findings}) == (name == "hardly any motion")


def test_nothing_is_wrong_with_one_that_looks_straight_down_and_the_command_says_so(
    tmp_path, capsys
):
    path = write_ros2(tmp_path / "bag", scans=20)
    settings = ("--set", "lidar.range_noise=0.03")
    code, out, _ = run(capsys, "doctor", path, *settings)
    *notes, last = out.splitlines()
    assert code == 0 and last.startswith("nothing is wrong with /lidar/points and /nav/pose: 20 of")
    assert len(notes) == 1 and notes[0].startswith("note:  the lidar turns too little")
    code, out, _ = run(capsys, "doctor", path, *settings, "--set", "frames.map=odom")
    assert code == 1 and "fix:   frames.map: map" in out
    code, out, _ = run(capsys, "doctor", path, *settings, "--set", "frames.map=odom", "--json")
    found = json.loads(out)
    assert found["findings"][0]["settings"] == {"frames.map": "map"}
    assert "20 of 20 scans mapped, 0.0 %" in found["verdict"]


def test_hills_in_a_long_narrow_view_are_no_mount(tmp_path, monkeypatch):
    """A spinning lidar on its side, of a drone that hardly turns."""
    across, along = np.meshgrid(np.tan(np.linspace(-1.3, 1.3, 192)), np.linspace(-0.47, 0.27, 8))
    view = np.stack([along, across, np.ones_like(along)], axis=-1)

    def way(t):
        angles = [3.0 * np.sin(1.7 * t), 2.5 * np.sin(1.3 * t + 1.0), 20.0 + 10.0 * np.sin(0.4 * t)]
        place = np.stack([0.8 * t - 3.0, 2.0 * np.sin(0.5 * t), 14.0 - 0.2 * t], axis=-1)
        return place, Rotation.from_euler("xyz", np.stack(angles, axis=-1), degrees=True)

    def hills(x, y):
        return 0.04 * x + 1.2 * np.sin(x / 14.0) * np.cos(y / 11.0)

    for name, other in (("rays", lambda: view), ("body", way), ("height", hills)):
        monkeypatch.setitem(globals(), name, other)
    path = Good().write(tmp_path / "bag")
    values = {**MOUNTED, "domain": {**DOMAIN, "xmin": -64.0, "ymin": -64.0, "size": 128.0}}
    info = inspect_bag(path, config_from_values(values), diagnose=True)
    assert info.works and not [f for f in info.findings if f.fix], info.findings


def test_a_damaged_bag_is_not_called_sound(tmp_path, capsys):
    settings = ("--set", "lidar.range_noise=0.03")
    path = write_ros2(tmp_path / "bag", scans=20)
    file = next(file for file in path.iterdir() if file.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 6 // 10])
    code, out, _ = run(capsys, "doctor", path, *settings)
    assert code == 3 and "\ndamaged: " in out


def test_points_out_of_range_say_nothing_of_axes(tmp_path):
    path = dataclasses.replace(Good(), **LIDAR_POSES).write(tmp_path / "bag")
    values = {**BASE, "lidar.max_range": 10.0}
    (found,) = (f for f in inspect_bag(path, config_from_values(values)).findings if f.fatal)
    assert "out of range" in found.text and "it would lie" not in found.text


def rays_with_legs():
    """Of a lidar that sees its vehicle: a fifth of the pixels return from 0.8 m."""
    legs = np.zeros(rays().shape[:2], dtype=bool)
    legs[:, :3] = legs[:, -3:] = True
    return legs.reshape(-1)


def with_legs(points, place, turn):
    del place, turn
    legs, points = rays_with_legs(), points.copy()
    points[legs] *= 0.8 / np.linalg.norm(points[legs], axis=1, keepdims=True)
    return points


def leaping(place, turn):
    """A jump of 2 m in height within each second."""
    del turn
    return place + [0.0, 0.0, 2.0 * (place[2] % 1.0 > 0.5)]


@pytest.mark.parametrize("off", [0.0, 9.0])
def test_returns_of_the_vehicle_are_named_and_hide_no_mount(off, tmp_path):
    path = dataclasses.replace(Good(), cloud=with_legs).write(tmp_path / "bag")
    config = config_from_values({**MOUNTED, "mount.pitch_deg": -off})
    info = inspect_bag(path, config, diagnose=True)
    found = {finding.key: finding for finding in info.findings if finding.fix}
    assert found.keys() == {"own_returns"} | ({"mount_angle"} if off else set())
    assert "at the same positions" in found["own_returns"].text
    assert 0.8 < found["own_returns"].settings["lidar.min_range"] < 1.2


def test_the_verdict_of_scans_that_disagree_is_no_good_one(tmp_path, capsys):
    path = dataclasses.replace(Good(), place=leaping).write(tmp_path / "bag")
    settings = [word for key, value in MOUNTED.items() for word in ("--set", f"{key}={value}")]
    code, out, _ = run(capsys, "doctor", path, *settings)
    last = out.splitlines()[-1]
    assert code == 1 and last.startswith("scans disagree by ")
    assert "see the fault above" in last and "% of the points contradict the map" in last
    cloud = dataclasses.replace(Good(), scan_times=np.full(20, 3.0)).write(tmp_path / "one_stamp")
    code, out, _ = run(capsys, "doctor", cloud, *settings)
    assert code == 1 and out.splitlines()[-1].startswith("19 of 20 scans dropped: all carry")


def test_scans_that_see_no_common_ground_prove_no_unit(tmp_path):
    """Strips of an aircraft: in millimetres the flight would shrink to one place."""
    far = {"place": lambda place, turn: place * [40.0, 40.0, 1.0] + [0.0, 0.0, 776.0]}
    good = dataclasses.replace(Good(), scan_times=np.arange(0.6, 7.4, 0.7), **far)
    path = good.write(tmp_path / "bag")
    info = inspect_bag(path, config_from_values({"mount.roll_deg": 180.0}), diagnose=True)
    assert not [finding for finding in info.findings if "units" in finding.key], info.findings


def test_clouds_that_are_sent_twice_are_mapped_once(tmp_path):
    path = dataclasses.replace(Good(), again=0.0).write(tmp_path / "bag")
    info = inspect_bag(path, config_from_values(MOUNTED), diagnose=True)
    assert info.works and "68 of 68 scans mapped" in info.verdict
    assert [finding.key for finding in info.findings if finding.key == "repeats"]


def tree(recorder):
    """The body's way on /tf, and the lidar on it, which looks down."""
    geometry = {name: recorder.type(f"geometry_msgs/msg/{name}") for name in (
        "TransformStamped", "Transform", "Vector3", "Quaternion")}  # fmt: skip
    for k in range(40):
        stamp, transforms = START + k * SECOND // 10, []
        place, turn = body(0.1 * k)
        for names, at, q in (
            (("odom", "base_link"), place, turn.as_quat()),
            (("base_link", "lidar"), (0.3, 0.0, -0.1), DOWN.as_quat()),
        ):
            transforms.append(
                geometry["TransformStamped"](
                    header=recorder.messages(names[0]).pose(stamp, at, q, np.zeros(36)).header,
                    child_frame_id=names[1],
                    transform=geometry["Transform"](
                        geometry["Vector3"](*map(float, at)),
                        geometry["Quaternion"](*map(float, q)),
                    ),
                )
            )
        message = recorder.type("tf2_msgs/msg/TFMessage")(transforms=transforms)
        recorder.write("/tf", message, "tf2_msgs/msg/TFMessage", stamp)


def test_a_mount_that_only_tf_has_is_tried_first(tmp_path):
    def before(place, turn):
        return place - turn.apply([0.3, 0.0, -0.1])

    path = dataclasses.replace(Good(), others=tree, place=before).write(tmp_path / "bag")
    info = inspect_bag(path, config_from_values(BASE), diagnose=True)
    (found,) = (finding for finding in info.findings if finding.settings)
    assert found.key == "mount_tf" and "base_link" in found.text
    assert found.settings["mount.x"] == 0.3 and found.settings["mount.z"] == -0.1
    assert abs(found.settings["mount.roll_deg"]) == 180.0
    assert info.suggestion.values["mount.x"] == 0.3


def test_dust_is_named_and_no_fault(tmp_path):
    rng = np.random.default_rng(70012)

    def dust(points, place, turn):
        floating = rng.random(len(points)) < 0.2
        return points * np.where(floating, rng.uniform(0.5, 0.95, len(points)), 1.0)[:, None]

    path = dataclasses.replace(Good(), cloud=dust).write(tmp_path / "bag")
    info = inspect_bag(path, config_from_values(MOUNTED), diagnose=True)
    (found,) = (finding for finding in info.findings if finding.key == "isolated")
    assert "dust" in found.text and not found.fix


def test_a_map_whose_z_is_not_up_is_named(tmp_path):
    tilt = Rotation.from_euler("y", 20.0, degrees=True)
    tilted = {
        "place": lambda place, turn: tilt.apply(place),
        "quaternion": lambda place, turn: (tilt * turn).as_quat(),
    }
    path = dataclasses.replace(Good(), **tilted).write(tmp_path / "bag")
    config = config_from_values({**MOUNTED, "domain": {**DOMAIN, "xmin": -24.0}})
    info = inspect_bag(path, config, diagnose=True)
    (found,) = (finding for finding in info.findings if finding.key == "tilt")
    assert "20 deg" in found.text and "gravity" in found.text
    assert info.verdict.startswith("the ground slopes by 20 deg on average: if it really does,")


def test_suggest_says_what_is_wrong_too(tmp_path, capsys):
    change, values, _, fix = FAULTS["clouds FLU, poses optical"]
    path = dataclasses.replace(Good(), **change).write(tmp_path / "bag")
    settings = [word for key, value in values.items() for word in ("--set", f"{key}={value}")]
    code, out, err = run(capsys, "config", "suggest", path, *settings)
    assert code == 0 and fix in out and fix in err
