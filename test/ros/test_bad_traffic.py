# SPDX-License-Identifier: Apache-2.0
"""Ten thousand messages that cannot be used, over DDS, beside good ones: both nodes live, and the
map is what it is without them."""

import functools
import math
from array import array
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from fuzz import cases
from fuzz.through import MAKER, Maps, Wishes
from geometry_msgs.msg import (
    Point32,
    PointStamped,
    PolygonInstanceStamped,
    PolygonStamped,
    PoseWithCovarianceStamped,
)
from nav_msgs.msg import OccupancyGrid
from ros.conftest import status_values
from ros.test_depth import FOCAL, SHAPE, CameraSensors
from ros_scene import MAKE, Sensors, cloud, pose
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from quadtree_lss.lab.live.listener import TOPICS
from quadtree_lss.onboard.config.sections import LidarConfig
from quadtree_lss.onboard.messages.clouds import MessageError, points_from_cloud, stamp_ns
from quadtree_lss.onboard.messages.depth import DepthCamera
from quadtree_lss.onboard.messages.landing_inputs import DECODE, prior_from_message
from quadtree_lss.onboard.messages.outputs import map_from_messages
from quadtree_lss.onboard.messages.poses import pose_from_message
from quadtree_lss.onboard.nodes.qos import latched, stream
from quadtree_lss.onboard.nodes.ros_messages import header_message

pytestmark = [pytest.mark.xdist_group("ros_faults"), pytest.mark.slow]

SCANS, MESSAGES, IDS = 60, 10_000, 10
NOW_NS = 1_700_000_000 * 10**9


def single(value):
    """What a message's float32 takes."""
    return float(value) if abs(value) < 3e38 else math.copysign(math.inf, value)


def header_of(made):
    header = header_message(0, made.header.frame_id[:100_000])
    header.stamp.sec, header.stamp.nanosec = made.header.stamp.sec, made.header.stamp.nanosec
    return header


def cloud_of(made):
    out = PointCloud2(header=header_of(made), is_bigendian=made.is_bigendian)
    out.fields = [PointField(**vars(f)) for f in made.fields if f.datatype < 256]
    for name in ("height", "width", "point_step", "row_step"):
        setattr(out, name, int(getattr(made, name)))
    out.data = array("B", bytes(made.data))
    return out


def pose_of(made):
    out = PoseWithCovarianceStamped(header=header_of(made))
    for part, names in (("position", "xyz"), ("orientation", "xyzw")):
        for name in names:
            setattr(
                getattr(out.pose.pose, part), name, getattr(getattr(made.pose.pose, part), name)
            )
    entries = made.pose.covariance
    out.pose.covariance = np.resize(entries, 36) if entries.size else np.full(36, -1.0)
    return out


def image_of(made):
    out = Image(header=header_of(made), encoding=made.encoding, is_bigendian=made.is_bigendian)
    out.height, out.width, out.step = int(made.height), int(made.width), int(made.step)
    out.data = array("B", bytes(made.data))
    return out


def info_of(made):
    out = CameraInfo(header=header_of(made), distortion_model=made.distortion_model)
    out.height, out.width = int(made.height), int(made.width)
    out.d, out.k, out.p = made.d.tolist(), made.k, made.p
    return out


def polygon_of(made):
    out = PolygonStamped(header=header_of(made))
    corners = made.polygon.points[:1001]
    out.polygon.points = [Point32(x=single(p.x), y=single(p.y), z=single(p.z)) for p in corners]
    return out


def one_of_set(made):
    """One of few, so that each can be lifted again."""
    out = PolygonInstanceStamped(header=header_of(made))
    bare = SimpleNamespace(header=made.header, polygon=made.polygon.polygon)
    out.polygon.polygon, out.polygon.id = polygon_of(bare).polygon, made.polygon.id % IDS
    return out


def target_of(made):
    out = PointStamped(header=header_of(made))
    out.point.x, out.point.y, out.point.z = made.point.x, made.point.y, made.point.z
    return out


def refused(decode, *args):
    """Whether a decoder refuses it: what it takes may change the map, and rightly so."""
    try:
        with np.errstate(all="ignore"):
            decode(*args)
    except MessageError:
        return True
    return False


class Bad:
    """Publishers of all inputs, and one message after the other that nobody can use."""

    def __init__(self, node, seed, source):
        self.rng, self.sent = np.random.default_rng(seed), Counter()
        scans = {"lidar/points": (PointCloud2, stream(50, reliable=True))}
        if source == "depth":
            scans = {
                "depth/image": (Image, stream(50, reliable=True)),
                "depth/camera_info": (CameraInfo, stream(50, reliable=True)),
            }
            self.good = cases.GOOD.camera(0, *SHAPE, FOCAL)
            self.camera = DepthCamera(LidarConfig())
            self.camera.on_info(self.good)
        kinds = scans | {
            "map/prior": (PoseWithCovarianceStamped, latched()),
            "nav/pose": (PoseWithCovarianceStamped, stream(200, reliable=True)),
            "map/cells": (PointCloud2, latched()),
            "map/observed": (OccupancyGrid, latched()),
            "landing/area": (PolygonStamped, latched()),
            "landing/keep_out": (PolygonStamped, latched()),
            "landing/keep_outs": (PolygonInstanceStamped, latched(IDS)),
            "landing/target": (PointStamped, latched()),
            "landing/dispersion": (PoseWithCovarianceStamped, latched()),
        }
        self.out = {
            topic: node.create_publisher(kind, topic, qos) for topic, (kind, qos) in kinds.items()
        }
        self.maps = Maps(np.random.default_rng(seed), "map")

    def send(self):
        """One, of any kind but the maps' halves, which go together."""
        topic = str(self.rng.choice([name for name in self.out if name != "map/observed"]))
        message = None
        while message is None:
            message = self.make(topic)
        self.out[topic].publish(message)
        self.sent[topic] += 1

    def make(self, topic):
        rng, name = self.rng, topic.partition("/")[2]
        if topic == "lidar/points":
            made = cloud_of(cases.random_cloud(rng, NOW_NS))
            wrong = refused(points_from_cloud, made) or refused(stamp_ns, made.header)
            return made if wrong else None
        if topic == "depth/image":
            made = cases.random_image(rng, NOW_NS, np.full(SHAPE, 100.0))
            wrong = refused(self.camera.points, made) or refused(stamp_ns, made.header)
            return image_of(made) if wrong else None
        if topic == "depth/camera_info":
            made = cases.random_camera_info(rng, self.good)
            return info_of(made) if refused(DepthCamera(LidarConfig()).on_info, made) else None
        if topic == "map/prior":
            made = pose_of(cases.random_pose(rng, cases.samples.pose(NOW_NS)))
            return made if refused(prior_from_message, made, "map") else None
        if topic == "nav/pose":
            good = cases.samples.pose(NOW_NS, (0.0, 0.0, 100.0), (1, 0, 0, 0))
            made = pose_of(cases.random_pose(rng, good))
            return made if refused(pose_from_message, made, "map") else None
        if topic == "map/cells":
            return self.make_map()
        kinds = {"target": target_of, "dispersion": pose_of, "keep_outs": one_of_set}
        made = kinds.get(name, polygon_of)(Wishes.MAKE[name](rng))
        return made if refused(DECODE[name], made, "map") else None

    def make_map(self):
        (_, cloud), (_, grid) = MAKER.of_map(self.maps.cells)
        self.maps.rng = self.rng
        self.maps.spoil_cells(cloud, grid)
        if not refused(map_from_messages, cloud, grid, self.maps.config.lss):
            return None
        if cloud.header.stamp.nanosec >= 10**9 or len(cloud.data) > 10**6:
            return None
        half = OccupancyGrid(header=header_of(cloud), data=grid.data)
        half.header.frame_id = "map"
        half.info.resolution = 0.5
        half.info.width, half.info.height = grid.info.width, grid.info.height
        self.out["map/observed"].publish(half)
        return cloud_of(cloud)


def mapped_at(listener, stamp):
    return listener.stamp("map/cells") == stamp


def sites_of(listener, stamp):
    """Whether there are some of a map; none before what was bad has been lifted."""
    sites = listener.newest.get("landing/sites")
    return listener.stamp("landing/sites") == stamp and len(sites.poses) > 0


@pytest.mark.parametrize("source", ["points", "depth"])
def test_bad_messages_beside_good_ones_change_nothing(ros, source):
    """Nor does somebody who has to land now, again and again."""
    grounds, args = [], ["-p", "qos.overload:=all", "-p", "pose.max_wait:=30.0"]
    args += ["-p", f"lidar.source:={source}"]
    for seed in (None, 1):
        mapping = ros.start("mapping_node", *args)
        of_prior = ("-p", "prior.file:=by_mapping_node_alone.npz")
        lss = ros.start("lss_node", *of_prior, "-p", "lss.max_risk:=0.05")
        with ros.listen(TOPICS) as listener:
            sensors, bad, make = Sensors(listener), None, cloud
            if source == "depth":
                sensors = CameraSensors(listener)
                make = sensors.image
            sensors.matched()
            if seed is not None:
                bad = Bad(listener.node, seed, source)

            def make_pose(stamp, bad=bad):
                """Bad ones before each good one."""
                due = MESSAGES * (stamp - FIRST_NS) / LONG_NS
                while bad is not None and bad.sent.total() < due:
                    bad.send()
                    if bad.sent.total() % (MESSAGES // 10) == 0:
                        ros.call(listener, "/lss_node/land_now")
                return pose(stamp)

            sensors.publish(SCANS, make_pose=make_pose, make_cloud=make)
            if bad is not None:
                while bad.sent.total() < MESSAGES:
                    bad.send()
                print(f"seed {seed}: {dict(bad.sent)}")
                for topic in ("landing/area", "landing/keep_out"):
                    bad.out[topic].publish(MAKE.polygon(1, []))
                for number in range(IDS):
                    bad.out["landing/keep_outs"].publish(MAKE.polygon(1, [], number))
            for number in range(2, 12):  # a late bad map may take a good one's place
                last = sensors.publish(1, offset_ns=number * LONG_NS, make_cloud=make)
                done = functools.partial(mapped_at, listener, last)
                assert listener.wait_for(done, timeout=120.0), mapping.output()[-9000:]
                if listener.wait_for(functools.partial(sites_of, listener, last), timeout=10.0):
                    break
            assert sites_of(listener, last), lss.output()[-9000:]
            cells = map_from_messages(listener.newest["map/cells"], listener.newest["map/observed"])
            side = np.linspace(-15.0, 15.0, 121)
            grounds.append(cells.at(side, side[:, None]).height)
            mapping.check()
            lss.check()
            if bad is not None:
                values = [status_values(listener, name) for name in ("mapping_node", "lss_node")]
                refusals = [
                    sum(int(n) for key, n in of.items() if key.startswith("problems."))
                    for of in values
                ]
                print(f"counted: {refusals}")
                assert min(refusals) > MESSAGES // 20
        for node in (mapping, lss):
            assert node.stop() == 0 and "Traceback" not in node.output()
    quiet, disturbed = grounds
    assert np.array_equal(np.isnan(quiet), np.isnan(disturbed))
    assert np.nanmax(np.abs(quiet - disturbed)) < 0.01


FIRST_NS, LONG_NS = NOW_NS, SCANS * 10**8
