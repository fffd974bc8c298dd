# SPDX-License-Identifier: Apache-2.0
"""Detection of faults of clouds and poses by comparing scans, with a fix for each fault.

Without faults, scans lie below the lidar and agree with each other. If they do not, the correction
of each common fault is tried; the fault with which scans agree clearly better is reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from quadtree_lss.desk.replay.configuration import scalar_text
from quadtree_lss.desk.replay.flight import MIN_IN_RANGE, Flight, place_lidar
from quadtree_lss.desk.replay.stream import mount_values
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, MountConfig
from quadtree_lss.onboard.core.geometry import rotations
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import AXES

MAX_LEFT, MIN_NOISES = 0.4, 3.0
"""Share of the disagreement that a correction may leave; least disagreement, range noises."""
MAX_ABOVE, MAX_ABOVE_CORRECTED = 0.5, 0.05
"""Limits of the share of points above the lidar: without a fault among buildings, after a fix."""
LAGS, FINE_LAGS = np.linspace(-0.5, 0.5, 21), np.linspace(-0.04, 0.04, 9)
"""Lags to try, s, and offsets to try around the best one, s."""
MIN_LAG, MAX_LEFT_FINE = 0.03, 0.8
"""Least lag, s; share of the disagreement that correcting a lag or an angle may leave."""
SWEEP_RATIO = 1.6
"""Least ratio of disagreement to scatter within scans that indicates motion during the scans."""
MIN_MOUNT_DEG, CALM_DEG, MAX_EVALUATIONS = 2.0, 5.0, 60
"""Least reported error of a mount; error that must be detectable, or the flight is too calm; limit
of the angles tried."""
STEEP_DEG = 12.0
"""Mean slope above which z of the map is probably not up."""
GEOGRAPHIC_M = 1e5
"""Least coordinates of a geographic grid."""
MIN_ALTERNATION, MIN_ALTERNATION_M = 5.0, 0.05
"""Least alternation of poses of two publishers, as a multiple of their steps and in m."""
MIN_JUMP, MIN_JUMP_M = 5.0, 0.1
"""Least speed of a jump of the poses, as a multiple of the speeds around it; least step, m."""
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
PITCHED_DOWN = rotations.exp([0.0, 0.5 * np.pi, 0.0])
"""Rotation of a lidar with its boresight along x of a level body that is pitched down."""


TfMounts = Mapping[str, tuple[Pose, dict[str, Any]]]
"""Possible mounts from transforms, with the settings that use them, by frame of the body."""


class Finding(NamedTuple):
    """A fault or a note. ``key``: short name; ``text``: one line; ``fix``: what to do, empty for a
    note; ``fatal``: nothing can be mapped; ``settings``: parameters that fix it; ``lag_s``: time to
    add to the clouds' stamps, s."""

    key: str
    text: str
    fix: str = ""
    fatal: bool = False
    settings: dict[str, Any] | None = None
    lag_s: float = 0.0

    @property
    def line(self) -> str:
        return f"{self.text}; fix: {self.fix}" if self.fix else self.text


def make_setting(key: str, text: str, settings: dict[str, Any]) -> Finding:
    """Make a finding whose fix is ``settings``."""
    fix = ", ".join(f"{name}: {scalar_text(value)}" for name, value in settings.items())
    return Finding(key, text, fix, settings=settings)


def find_faults(
    flight: Flight, config: Config, tf_mounts: TfMounts, period: float
) -> list[Finding]:
    """Find faults by comparing the scans. ``period``: time from scan to scan, s; 0 if points have
    times, NaN if these cannot be read: then no lag is estimated."""
    fault, found = _find_common_fault(flight, config, tf_mounts), []
    if fault is None and (own := flight.exclude_own_returns()) is not None:
        share, farthest = own
        text = f"{100 * share:.0f} % of the returns are always at the same positions within"
        text += f" {farthest:.2g} m of the lidar: the vehicle itself"
        settings = {"lidar.min_range": float(np.ceil(11.0 * farthest)) / 10.0}
        found = [make_setting("own_returns", text, settings)]
        fault = _find_common_fault(flight, config, tf_mounts)
    if fault is not None:
        return [*found, fault]
    found += _find_lag(flight, period) if period == period else []
    return [*found, *_find_mount_angle(flight, config), *_find_tilt(flight)]


def find_pose_faults(poses: list[tuple[int, Array, Array]]) -> list[Finding]:
    """Find poses of two publishers on one topic, jumps, and coordinates of a geographic grid."""
    poses = sorted(poses, key=lambda pose: pose[0])
    positions, stamps = np.array([pose[1] for pose in poses]), np.array([pose[0] for pose in poses])
    if len(positions) < 8:
        return []
    offsets = np.linalg.norm(positions[1:-1] - 0.5 * (positions[:-2] + positions[2:]), axis=1)
    step = np.median(np.linalg.norm(positions[2:] - positions[:-2], axis=1))
    offset = np.median(offsets)
    if offset > max(MIN_ALTERNATION * step, MIN_ALTERNATION_M):
        text = f"poses alternate between two paths {offset:.2g} m apart: two publishers?"
        return [Finding("two_paths", text, "record each on its own topic and choose one of them")]
    found = []
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    speeds = steps / np.maximum(1e-9 * np.diff(stamps), 1e-6)
    around = np.maximum(speeds[:-2], speeds[2:])
    jumps = 1 + np.flatnonzero((speeds[1:-1] > MIN_JUMP * around) & (steps[1:-1] > MIN_JUMP_M))
    if len(jumps):
        k = jumps[np.argmax(steps[jumps])]
        text = f"poses jump {len(jumps)} times, by {steps[k]:.2g} m at {1e-9 * stamps[k]:.3f} s,"
        found.append(Finding("jump", f"{text} as after a loop closure or a new GNSS solution"))
    x, y, _ = np.median(positions, axis=0)
    if max(abs(x), abs(y)) > GEOGRAPHIC_M:
        text = f"poses are about x {x:.0f}, y {y:.0f} m, as in UTM: the domain must lie there, as"
        text += " `config suggest` writes it, and the results have these coordinates"
        found.append(Finding("far", text))
    return found


class _Correction(NamedTuple):
    """A fault, and positions, rotations and unit of the lidar without it."""

    fault: Finding
    origins: Array
    turns: Array
    scale: float = 1.0


NO_MOUNT: dict[str, Any] = {f"mount.{name}": value for name, value in asdict(MountConfig()).items()}
ADVICE = {
    "map_cloud": (
        "clouds are in the map frame already",
        "choose clouds in the lidar's axes by --scan-topic (of FAST-LIO: /cloud_registered_body),"
        " or transform these back by their poses (docs/connecting.md)",
    ),
    "ned": (
        "poses are in north, east, down; the map is east, north, up",
        "convert them (docs/connecting.md), or use nav/pose of autopilot_node or MAVROS",
    ),
    "quaternion": ("orientations have w first", "send x, y, z, w: q[1], q[2], q[3], q[0]"),
    "inverse": (
        "orientations rotate map axes to lidar axes, not lidar axes to map axes",
        "send their inverse: -x, -y, -z, w",
    ),
}
"""Texts and fixes of faults that no parameter fixes."""


def _list_corrections(flight: Flight, config: Config, tf_mounts: TfMounts) -> list[_Correction]:
    """List the common faults, the more likely ones first."""
    p, b, m, origins = flight.positions, flight.body, flight.mounts, flight.origins
    found = _list_mounts(flight, config, tf_mounts)

    def advise(key: str, origins: Array, turns: Array) -> _Correction:
        return _Correction(Finding(key, *ADVICE[key]), origins, turns)

    ned = NED_FROM_ENU
    north = [  # of a body with axes forward, left, up or forward, right, down
        advise("ned", *place_lidar(p @ ned.T, ned @ b @ axes, flight.arms, m))
        for axes in (np.eye(3), LOOKING_DOWN)
    ]
    found = north + found if np.median(p[:, 2]) < 0.0 else found + north
    quaternions = rotations.quaternion_from_rotation(b)
    first = rotations.rotation_from_quaternion(quaternions[:, [1, 2, 3, 0]])
    found.append(advise("quaternion", origins, first @ m))
    found.append(advise("inverse", p, b.transpose(0, 2, 1) @ m))
    for scale, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        fault = Finding("units", f"clouds are in {unit}", f"send metres: x, y, z times {scale:g}")
        found.append(_Correction(fault, origins, b @ m, scale))
        fix = f"send metres: positions times {scale:g}"
        fault = Finding("pose_units", f"poses are in {unit}", fix)
        if not abs(np.log(flight.unit_of_heights() / scale)) > np.log(2.0):
            found.append(_Correction(fault, scale * p + origins - p, b @ m))
    return [*found, advise("map_cloud", np.zeros_like(p), np.tile(np.eye(3), (len(p), 1, 1)))]


def _list_mounts(flight: Flight, config: Config, tf_mounts: TfMounts) -> list[_Correction]:
    """List faults of the mount and the axes of the clouds."""
    p, b, origins = flight.positions, flight.body, flight.origins
    own = flight.mounts @ AXES[config.mount.axes].T
    found = []
    for frame, (mount, settings) in tf_mounts.items():
        fault = make_setting(
            "mount_tf", f"poses are of '{frame}', on which /tf has the lidar", settings
        )
        arm, turn = np.broadcast_to(mount.position, p.shape), mount.rotation_map_lidar
        found.append(_Correction(fault, *place_lidar(p, b, arm, np.broadcast_to(turn, b.shape))))
    for name, turn in AXES.items():
        if name != config.mount.axes:
            text = f"clouds and poses have different axes ({name.replace('_', ' ')})"
            fault = make_setting("axes", text, {"mount.axes": name})
            found.append(_Correction(fault, origins, b @ own @ turn))
    if not np.allclose(own, np.eye(3), atol=1e-6):
        axes, text = {**NO_MOUNT, "mount.axes": config.mount.axes}, "poses are those of the lidar"
        fault = Finding("mount", f"{text}, and a mount is set", "remove mount.*", settings=axes)
        if config.mount.source == "tf":
            fault = Finding("mount", text, "correct their child frame")
        found.append(_Correction(fault, p, b @ AXES[config.mount.axes]))
    text = "poses are those of a level body, and the lidar looks down from it"
    downward = (("mount.roll_deg", 180.0, LOOKING_DOWN), ("mount.pitch_deg", 90.0, PITCHED_DOWN))
    for name, angle, turn in downward if config.mount.source == "fixed" else ():
        fault = make_setting("mount", text, {name: angle})
        found.append(_Correction(fault, origins, b @ own @ turn))
    return found


def _find_common_fault(flight: Flight, config: Config, tf_mounts: TfMounts) -> Finding | None:
    """Find the fault of axes, frames or units whose correction makes scans agree clearly better."""
    cost, above = flight.disagreement(flight.origins, flight.turns)
    noise = config.lidar.range_noise
    plausible = above <= MAX_ABOVE and flight.used().mean() > MIN_IN_RANGE
    separate = not np.isfinite(cost)  # no overlap: only the unit of the poses can explain that
    small = cost <= MIN_NOISES * noise
    if plausible and (small or separate and np.isnan(flight.unit_of_heights())):
        return None
    best, least = None, np.inf
    for correction in _list_corrections(flight, config, tf_mounts):
        fault, origins, turns, scale = correction
        if plausible and separate and fault.key != "pose_units":
            continue
        if flight.used(scale).mean() <= MIN_IN_RANGE:
            continue
        if plausible and scale != 1.0 and cost < 30.0 * noise:
            continue
        left, over = flight.disagreement(origins, turns, scale)
        if fault.key == "map_cloud":
            over = float(np.mean(flight.points[:, 2] > flight.positions[flight.scan, 2]))
        if over <= MAX_ABOVE_CORRECTED and left < 0.8 * least:
            best, least = fault, left
    texts = [f"{100 * above:.0f} % of the ground lies above the lidar"] * (above > MAX_ABOVE)
    if best is not None and (not plausible or least < MAX_LEFT * cost):
        before = f"disagree by {cost:.2g} m" if np.isfinite(cost) else "do not overlap"
        texts.append(f"scans {before}, and disagree by {least:.2g} m without this fault")
        return best._replace(text=f"{best.text}: {', '.join(texts)}")
    if not texts:
        return None
    return Finding("above", texts[0], "check frames and axes (docs/connecting.md)")


def _find_tilt(flight: Flight) -> list[Finding]:
    """Find a mean slope that is probably a tilt of the map's axes."""
    used = flight.used()
    if used.mean() <= MIN_IN_RANGE:
        return []
    scan = flight.scan[used]
    points = np.einsum("nij,nj->ni", flight.turns[scan], flight.points[used]) + flight.origins[scan]
    normal = np.linalg.eigh(np.cov(points.T))[1][:, 0]
    slope = float(np.degrees(np.arccos(min(abs(normal[2]), 1.0))))
    if slope < STEEP_DEG:
        return []
    text = f"the ground slopes by {slope:.0f} deg on average; if it does not, z of the map is not"
    text += " up, as with an odometry that starts with the lidar's first attitude (camera_init):"
    text += " align that with gravity, or with its IMU, and run it on the recording again"
    return [Finding("tilt", text)]


def _find_lag(flight: Flight, period: float) -> list[Finding]:
    """Find a constant delay between clouds and poses with which scans agree."""
    chosen = (flight.times > -LAGS[0]) & (flight.times < flight.last - LAGS[-1])
    if np.count_nonzero(chosen) < 3:
        return []
    costs = [flight.disagreement_with_lag(lag, chosen) for lag in LAGS]
    cost, near = costs[len(LAGS) // 2], LAGS[int(np.argmin(costs))] + FINE_LAGS
    costs = [flight.disagreement_with_lag(lag, chosen) for lag in near]
    least, lag = min(costs), float(near[int(np.argmin(costs))])
    scatter = flight.scatter_within_scans()
    if not scatter < cost < np.inf or abs(lag) < MIN_LAG or least > MAX_LEFT_FINE * cost:
        return []
    gain = f"scans disagree by {cost:.2g} m, and by {least:.2g} m with the poses at that time"
    if 0.0 < lag < period and least > SWEEP_RATIO * scatter:
        text = f"points have no times, and those of a scan span about {2.0 * lag:.2g} s: {gain}"
        return [
            Finding("times_missing", text, "send the time of each point (docs/messages/inputs.md)")
        ]
    when = "late" if lag < 0.0 else "early"
    text = f"clouds are stamped {abs(lag):.2f} s too {when} against the poses: {gain}"
    fix = f"add {lag:+.2f} s to the clouds' stamps (the driver's time offset), or correct those of"
    return [Finding("lag", text, f"{fix} the poses", lag_s=lag)]


def _find_mount_angle(flight: Flight, config: Config) -> list[Finding]:
    """Find the rotation of the lidar about two axes normal to its mean ray with which scans agree
    best."""
    if config.mount.source == "gimbal":
        return []
    across = np.linalg.svd(flight.points.mean(axis=0)[None])[2][1:]

    def disagreement(angles: Array) -> float:
        return flight.disagreement(flight.origins, flight.turns @ rotations.exp(angles @ across))[0]

    calm = np.radians(CALM_DEG)
    cost, *costs = (
        disagreement(calm * np.array(a)) for a in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    )
    if not np.isfinite(cost):
        return []
    simplex = calm * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": simplex, "maxfev": MAX_EVALUATIONS}
    options |= {"xatol": 1e-3, "fatol": 0.01 * cost}
    fit = minimize(disagreement, simplex[0], method="Nelder-Mead", options=options)
    angle, turn = float(np.degrees(np.linalg.norm(fit.x))), rotations.exp(fit.x @ across)
    scatter = flight.scatter_within_scans()
    if angle < MIN_MOUNT_DEG or fit.fun > MAX_LEFT_FINE * cost or cost < scatter:
        if min(max(costs[:2]), max(costs[2:])) * MAX_LEFT_FINE > max(cost, scatter):
            return []
        text = "the lidar turns too little to find a short lag, or a mount that is off by"
        text += f" {CALM_DEG:g} deg: turn and sway the vehicle while you record"
        return [Finding("calm", text)]
    mount = flight.mounts[0] @ turn @ AXES[config.mount.axes].T
    values = mount_values(flight.arms[0], mount, digits=1)
    text = f"the mount is wrong by {angle:.1f} deg: scans disagree by {cost:.2g} m, and by"
    text += f" {fit.fun:.2g} m with the corrected mount"
    if config.mount.source == "tf":
        return [make_setting("mount_angle", text, {"mount.source": "fixed", **values})]
    angles = {name: value for name, value in values.items() if name.endswith("_deg")}
    return [make_setting("mount_angle", text, angles)]
