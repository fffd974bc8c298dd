# SPDX-License-Identifier: Apache-2.0
"""Bags for tests, written with rosbags: a lidar that looks straight down on a gentle slope."""

from contextlib import contextmanager
from functools import partial

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from quadtree_lss.lab.simulation.recording import CLOUD, POSE, Messages
from quadtree_lss.onboard.messages.landing_inputs import INSTANCE_TYPE, POINT_TYPE, POLYGON_TYPE

HEADER = "std_msgs/msg/Header"
SECOND = 10**9
START = 1_700_000_000 * SECOND
GROUND = {
    "domain.xmin": -16.0,
    "domain.ymin": -16.0,
    "domain.size": 32.0,
    "domain.min_level": 3,
    "domain.max_level": 6,
    "lidar.range_noise": 0.03,
    "lss.max_gap": 3.0,
    "lss.max_risk": 0.9,  # so few returns say little
}
"""Configuration that fits the ground these bags show."""

KEEP_OUT = [(0.0, -15.0), (15.0, -15.0), (15.0, 15.0), (0.0, 15.0)]
"""The eastern half of this ground."""

LOOKING_DOWN = (1.0, 0.0, 0.0, 0.0)  # quaternion of a half turn about x: z down, y south


class Recorder:
    """Serialises messages for a ROS 2 or ROS 1 writer."""

    def __init__(self, writer, ros1=False):
        self.writer, self.ros1 = writer, ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        self.types, self.connections = dict(self.store.types), {}
        if ros1:
            self.types[HEADER] = partial(self.types[HEADER], seq=0)

    def write(self, topic, message, kind, received_ns):
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.write_raw(topic, serialize(message, kind), kind, received_ns)

    def write_raw(self, topic, raw, kind, received_ns):
        if topic not in self.connections:
            connection = self.writer.add_connection(topic, kind, typestore=self.store)
            self.connections[topic] = connection
        self.writer.write(self.connections[topic], received_ns, raw)

    def type(self, name):
        return self.types[name]

    def messages(self, frame="map"):
        return Messages(self.types, frame=frame)

    def cloud(self, stamp_ns, points):
        return self.messages().scan(stamp_ns, points)

    def pose(self, stamp_ns, position, xyzw=LOOKING_DOWN, frame="map"):
        covariance = np.diag([1e-4] * 3 + [1e-8] * 3)
        return self.messages(frame).pose(stamp_ns, position, xyzw, covariance)


def flight(
    recorder, scans=10, scan_topics=("/lidar/points",), pose_topics=("/nav/pose",), across=24
):
    """Poses at 20 Hz and scans at 10 Hz between them, 50 m above z = 0.05 x, noise 3 cm."""
    rng = np.random.default_rng(11)
    side = np.linspace(-0.5, 0.5, across)
    right, down = np.meshgrid(side, side)
    for k in range(2 * scans + 2):
        stamp = START + k * SECOND // 20
        position = np.array([0.2 * k - 2.0, 0.0, 50.0])
        for topic in pose_topics:
            recorder.write(topic, recorder.pose(stamp, position), POSE, stamp + 2_000_000)
        if k % 2 or k == 2 * scans:
            continue
        scan = stamp + SECOND // 50
        position[0] += 0.2 * 20 / 50  # where the lidar is then
        depth = (position[2] - 0.05 * position[0]) / (1.0 + 0.05 * right)
        depth += rng.normal(scale=0.03, size=depth.shape)
        points = np.stack([right * depth, down * depth, depth], axis=-1)
        for topic in scan_topics:
            recorder.write(topic, recorder.cloud(scan, points), CLOUD, scan + 5_000_000)


class LandingRecorder(Recorder):
    """Writes what may be asked of landing as well."""

    def polygon(self, topic, corners, received_ns, frame="map"):
        message = self.messages(frame).polygon(received_ns, corners)
        self.write(topic, message, POLYGON_TYPE, received_ns)

    def keep_out(self, number, corners, received_ns):
        message = self.messages().polygon(received_ns, corners, number)
        self.write("/landing/keep_outs", message, INSTANCE_TYPE, received_ns)

    def target(self, topic, x, y, received_ns):
        message = self.messages().point(received_ns, (x, y, 0.0))
        self.write(topic, message, POINT_TYPE, received_ns)


@contextmanager
def recording(path, kind=Recorder, plugin="mcap", compression=None):
    """Recorder of a rosbag2 directory, with compression "file" or "message", or of a ROS 1 file
    ``….bag``, with BZ2 or LZ4."""
    ros1 = path.suffix == ".bag"
    if ros1:
        writer = Ros1Writer(path)
        if compression:
            writer.set_compression(Ros1Writer.CompressionFormat[compression])
    else:
        writer = Writer(path, version=9, storage_plugin=StoragePlugin[plugin.upper()])
        if compression:
            mode = CompressionMode[compression.upper()]
            writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        yield kind(writer, ros1)


def write_ros2(path, *, plugin="mcap", compression=None, **options):
    """A rosbag2 directory of a `flight`, or a ROS 1 file of it."""
    with recording(path, plugin=plugin, compression=compression) as recorder:
        flight(recorder, **options)
    return path


def storage_file(path):
    """The one file in a rosbag2 directory that holds the messages."""
    (file,) = (p for p in path.iterdir() if p.name != "metadata.yaml")
    return file
