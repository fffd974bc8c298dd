#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Hands the target of ``landing/selected`` to an autopilot: what MAVLink's LANDING_TARGET holds.

| topic | message | for |
| --- | --- | --- |
| ``landing_target/local_ned`` | PoseStamped | x, y, z, q in MAV_FRAME_LOCAL_NED, for PX4 |
| ``landing_target/body_frd`` | PointStamped | x, y, z in MAV_FRAME_BODY_FRD, for ArduPilot |
| ``landing_target/geographic`` | NavSatFix | latitude, longitude, height, with ``datum`` only |

They are sent ``rate`` times a second while there is a target, and stop when it is withdrawn or
when lss_node is heard of no more: an autopilot then knows that there is none.

    python3 landing_target.py --ros-args -p datum:=[47.35,8.36,420.0] -r nav/pose:=/ekf/body_pose

Parameters:
    datum: Latitude and longitude (degrees, WGS 84) and ellipsoidal height (m) of the map's origin.
    map_yaw_deg: From east to the map's x axis, anticlockwise; 0 where the map is ENU.
    local_origin: Where the autopilot's local origin lies in the map, m.
    body_axes: Of ``nav/pose``, the body's pose in the map: flu (ROS, REP 103) or frd (aviation).
    rate: Hz; ArduPilot asks for at least 1.
"""

import math
import signal

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import NavSatFix, NavSatStatus

TARGET = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    deadline=Duration(seconds=1.0),  # lss_node says its target again before that
)
WGS84_A, WGS84_F = 6378137.0, 1.0 / 298.257223563
HALF = math.sqrt(0.5)
# Quaternions x, y, z, w. Half a turn about the axis between east and north exchanges ENU and NED,
# half a turn about the forward axis exchanges FLU and FRD.
NED_ENU = np.array([HALF, HALF, 0.0, 0.0])
FLU_FRD = np.array([1.0, 0.0, 0.0, 0.0])


def multiplied(p, q):
    """Quaternion of the turn q and then p."""
    (a, b, c, w), (d, e, f, v) = p, q
    return np.array(
        [
            w * d + a * v + b * f - c * e,
            w * e - a * f + b * v + c * d,
            w * f + a * e - b * d + c * v,
            w * v - a * d - b * e - c * f,
        ]
    )


def inverse(q):
    """The turn back."""
    return q * [-1.0, -1.0, -1.0, 1.0]


def turned(q, vector):
    """The vector, turned."""
    return multiplied(multiplied(q, [*vector, 0.0]), inverse(q))[:3]


def enu_map(yaw_deg):
    """Quaternion that takes the map's axes to east, north, up."""
    half = 0.5 * math.radians(yaw_deg)
    return np.array([0.0, 0.0, math.sin(half), math.cos(half)])


def local_ned(position, orientation, yaw_deg=0.0, origin=(0.0, 0.0, 0.0)):
    """Place (north, east, down) from the origin, and attitude of forward, right, down axes."""
    to_ned = multiplied(NED_ENU, enu_map(yaw_deg))
    place = turned(to_ned, np.subtract(position, origin))
    return place, multiplied(multiplied(to_ned, orientation), FLU_FRD)


def body_frd(position, body_position, body_orientation, axes="flu"):
    """Place forward, right and down of the body."""
    place = turned(inverse(body_orientation), np.subtract(position, body_position))
    return turned(FLU_FRD, place) if axes == "flu" else place


def geographic(position, datum, yaw_deg=0.0):
    """Latitude, longitude (degrees) and ellipsoidal height (m) of a place in the map."""
    lat, lon = np.radians(datum[:2])
    east, north, up = turned(enu_map(yaw_deg), position)
    e2 = WGS84_F * (2.0 - WGS84_F)
    n = WGS84_A / math.sqrt(1.0 - e2 * math.sin(lat) ** 2)
    # In the meridian's plane: r from the axis, z along it; the axes of the datum are turned by lat.
    r = (n + datum[2]) * math.cos(lat) + up * math.cos(lat) - north * math.sin(lat)
    z = (n * (1.0 - e2) + datum[2]) * math.sin(lat) + up * math.sin(lat) + north * math.cos(lat)
    longitude, r = lon + math.atan2(east, r), math.hypot(east, r)
    latitude = math.atan2(z, r * (1.0 - e2))
    for _ in range(10):  # converges by a factor of some hundreds each time
        n = WGS84_A / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        latitude = math.atan2(z + e2 * n * math.sin(latitude), r)
    n = WGS84_A / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
    height = r * math.cos(latitude) + z * math.sin(latitude)
    height -= n * (1.0 - e2 * math.sin(latitude) ** 2)
    return math.degrees(latitude), math.degrees(longitude), height


def numbers(point):
    """x, y, z, and w if there is one."""
    return np.array([getattr(point, name) for name in "xyzw" if hasattr(point, name)])


class LandingTarget(Node):
    """The node."""

    def __init__(self):
        super().__init__("landing_target")
        self._datum = self.declare_parameter("datum", [math.nan] * 3).value
        self._yaw = self.declare_parameter("map_yaw_deg", 0.0).value
        self._origin = self.declare_parameter("local_origin", [0.0] * 3).value
        self._axes = self.declare_parameter("body_axes", "flu").value
        self._target = self._body = None
        self._ned = self.create_publisher(PoseStamped, "landing_target/local_ned", 10)
        self._frd = self.create_publisher(PointStamped, "landing_target/body_frd", 10)
        self._fix = self.create_publisher(NavSatFix, "landing_target/geographic", 10)
        late = SubscriptionEventCallbacks(deadline=lambda event: self._lose("is not heard of"))
        self.create_subscription(
            PoseWithCovarianceStamped, "landing/selected", self._on_target, TARGET,
            event_callbacks=late,
        )  # fmt: skip
        any_publisher = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(
            PoseWithCovarianceStamped, "nav/pose", self._on_body, any_publisher
        )
        self.create_timer(1.0 / self.declare_parameter("rate", 5.0).value, self._send)

    def _on_target(self, message):
        if not np.isfinite(numbers(message.pose.pose.position)).all():
            self._lose("is withdrawn")
            return
        if self._target is None:
            self.get_logger().info("there is a target")
        self._target = message

    def _lose(self, why):
        if self._target is not None:
            self.get_logger().warning(f"the target {why}: nothing is sent")
        self._target = None

    def _on_body(self, message):
        self._body = message

    def _send(self):
        if self._target is None:
            return
        stamp, pose = self._target.header.stamp, self._target.pose.pose
        position, orientation = numbers(pose.position), numbers(pose.orientation)
        ned = PoseStamped()
        ned.header.stamp, ned.header.frame_id = stamp, "local_ned"
        place, attitude = local_ned(position, orientation, self._yaw, self._origin)
        fill(ned.pose.position, place)
        fill(ned.pose.orientation, attitude)
        self._ned.publish(ned)
        if self._body is not None:
            body = self._body.pose.pose
            frd = PointStamped()
            frd.header.stamp, frd.header.frame_id = self._body.header.stamp, "body_frd"
            where = (numbers(body.position), numbers(body.orientation))
            fill(frd.point, body_frd(position, *where, self._axes))
            self._frd.publish(frd)
        if np.isfinite(self._datum).all():
            self._fix.publish(self._geographic(stamp, position))

    def _geographic(self, stamp, position):
        fix = NavSatFix()
        fix.header.stamp, fix.header.frame_id = stamp, "wgs84"
        fix.status.status = NavSatStatus.STATUS_FIX
        fix.latitude, fix.longitude, fix.altitude = geographic(position, self._datum, self._yaw)
        covariance = self._target.pose.covariance.reshape(6, 6)[:3, :3]
        axes = np.array([turned(enu_map(self._yaw), axis) for axis in np.eye(3)]).T
        fix.position_covariance = (axes @ covariance @ axes.T).ravel()
        fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
        return fix


def fill(target, values):
    """Sets x, y, z, w in this order."""
    for name, value in zip("xyzw", values, strict=False):
        setattr(target, name, float(value))


def main():
    """Runs until it is told to stop."""
    # ROS's own handlers end the context at once, and whatever is being sent fails.
    stop = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.append(True))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = LandingTarget()
    while not stop:
        rclpy.spin_once(node, timeout_sec=0.2)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
