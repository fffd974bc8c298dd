# SPDX-License-Identifier: Apache-2.0
"""Faults of clouds and poses that the ground shows, and the fix for each.

Scans that are placed right lie below the lidar and agree with each other. Each common fault is
corrected in turn. It is reported if scans disagree, and agree clearly better with the correction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from quadtree_lss.desk.replay.configuration import scalar_text
from quadtree_lss.desk.replay.flight import IN_RANGE, Flight, place_lidar
from quadtree_lss.desk.replay.stream import mount_values
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, MountConfig
from quadtree_lss.onboard.core.geometry.rotations import (
    exp,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import AXES, cloud_rotation
from quadtree_lss.onboard.messages.lost_points import LOOKING_DOWN, NED_FROM_ENU

BETTER, NOISES = 0.4, 3.0
"""A correction leaves at most this share of a disagreement of at least this many range noises."""
MOST_ABOVE, CORRECTED_ABOVE = 0.5, 0.05
"""Most points above the lidar, as a share: of a sound flight among houses, and after a fix."""
LAGS, FINER_LAGS = np.linspace(-0.5, 0.5, 21), np.linspace(-0.04, 0.04, 9)
"""Lags to try, s, and those to try about the best one."""
LEAST_LAG, GAIN = 0.03, 0.8
"""Least lag, s, and most of the disagreement that may remain without a lag or an angle."""
SWEPT = 1.6
"""Scans that still differ by so many times their own scatter were taken while the lidar moved."""
LEAST_DEG, CALM_DEG, ATTEMPTS = 2.0, 5.0, 60
"""Least angle of a mount that is off; an angle that a flight must show, or it is too calm; most
angles to try."""
STEEP_DEG = 12.0
"""A mean slope from which on z of the map is probably not up."""
FAR_M, ZIGZAG, LEAST_ZIGZAG_M = 1e5, 5.0, 0.05
"""Least coordinates of a geographic grid; poses of two publishers alternate by so many steps and by
more than the last."""
JUMP, LEAST_JUMP_M = 5.0, 0.1
"""Least speed of a jump of the poses, as a multiple of those around it, and least step."""
PITCHED_DOWN = exp([0.0, 0.5 * np.pi, 0.0])
"""Rotation of a lidar that looks along x of a level body and is pitched down."""


TfMounts = Mapping[str, tuple[Pose, dict[str, Any]]]
"""Mounts that transforms allow, and the settings that use them, by the frame of the body."""


class Finding(NamedTuple):
    """A fault or a note. ``key``: short name; ``text``: what was found, in one line; ``fix``: what
    to do about it, empty for a note; ``fatal``: whether nothing can be mapped; ``settings``:
    parameters that fix it; ``lag_s``: time to add to the clouds' stamps."""

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
    """Make a finding that parameters fix."""
    fix = ", ".join(f"{name}: {scalar_text(value)}" for name, value in settings.items())
    return Finding(key, text, fix, settings=settings)


def find_faults(
    flight: Flight, config: Config, tf_mounts: TfMounts, period: float
) -> list[Finding]:
    """Compare the scans with each other. ``period``: time from scan to scan if points have no
    times, s; 0 if they have, NaN if these cannot be read: then no lag is looked for."""
    fault, found = _find_common_fault(flight, config, tf_mounts), []
    if fault is None and (own := flight.leave_out_own()) is not None:
        share, farthest = own
        text = f"{100 * share:.0f} % of the returns are always at the same place close by, within"
        text += f" {farthest:.2g} m of the lidar: the vehicle itself"
        least = {"lidar.min_range": float(np.ceil(11.0 * farthest)) / 10.0}
        found = [make_setting("own_returns", text, least)]
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
    leaps = np.linalg.norm(positions[1:-1] - 0.5 * (positions[:-2] + positions[2:]), axis=1)
    leap, step = np.median(leaps), np.median(np.linalg.norm(positions[2:] - positions[:-2], axis=1))
    if leap > max(ZIGZAG * step, LEAST_ZIGZAG_M):
        text = f"poses alternate between two paths {leap:.2g} m apart: two publishers?"
        return [Finding("two_paths", text, "record each on its own topic and choose one of them")]
    found = []
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    speeds = steps / np.maximum(1e-9 * np.diff(stamps), 1e-6)
    usual = np.maximum(speeds[:-2], speeds[2:])
    jumps = 1 + np.flatnonzero((speeds[1:-1] > JUMP * usual) & (steps[1:-1] > LEAST_JUMP_M))
    if len(jumps):
        k = jumps[np.argmax(steps[jumps])]
        text = f"poses jump {len(jumps)} times, by {steps[k]:.2g} m at {1e-9 * stamps[k]:.3f} s,"
        found.append(Finding("jump", f"{text} as after a loop closure or a new GNSS solution"))
    x, y, _ = np.median(positions, axis=0)
    if max(abs(x), abs(y)) > FAR_M:
        text = f"poses are about x {x:.0f}, y {y:.0f} m, as in UTM: the domain must lie there, as"
        text += " `config suggest` writes it, and the results will, too"
        found.append(Finding("far", text))
    return found


class _Correction(NamedTuple):
    """A fault, and the lidar's positions and rotations without it."""

    fault: Finding
    origins: Array
    turns: Array
    scale: float = 1.0


NO_MOUNT: dict[str, Any] = {f"mount.{name}": value for name, value in asdict(MountConfig()).items()}
ADVICE = {
    "map_cloud": (
        "clouds are in the map frame already",
        "choose clouds in the lidar's axes by --scan-topic (of FAST-LIO: /cloud_registered_body),"
        " or take these back to them by their poses (docs/connecting.md)",
    ),
    "ned": (
        "poses are in north, east, down; the map is east, north, up",
        "convert them (docs/connecting.md), or take nav/pose of autopilot_node or MAVROS",
    ),
    "quaternion": ("orientations have w first", "send x, y, z, w: q[1], q[2], q[3], q[0]"),
    "inverse": (
        "orientations take the map's axes to the lidar's, not back",
        "send their inverse: -x, -y, -z, w",
    ),
}
"""Texts and fixes of faults that no parameter fixes."""


def _list_corrections(flight: Flight, config: Config, tf_mounts: TfMounts) -> list[_Correction]:
    """List the common faults, the likelier first."""
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
    first = rotation_from_quaternion(quaternion_from_rotation(b)[:, [1, 2, 3, 0]])
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
    own = flight.mounts @ cloud_rotation(config.mount).T
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
        keep, text = {**NO_MOUNT, "mount.axes": config.mount.axes}, "poses are those of the lidar"
        fault = Finding("mount", f"{text}, and a mount is set", "remove mount.*", settings=keep)
        if config.mount.source == "tf":
            fault = Finding("mount", text, "correct their child frame")
        found.append(_Correction(fault, p, b @ cloud_rotation(config.mount)))
    text = "poses are those of a level body, and the lidar looks down from it"
    downward = (("mount.roll_deg", 180.0, LOOKING_DOWN), ("mount.pitch_deg", 90.0, PITCHED_DOWN))
    for name, angle, turn in downward if config.mount.source == "fixed" else ():
        fault = make_setting("mount", text, {name: angle})
        found.append(_Correction(fault, origins, b @ own @ turn))
    return found


def _find_common_fault(flight: Flight, config: Config, tf_mounts: TfMounts) -> Finding | None:
    """Find the fault of axes, frames or units without which scans agree clearly better."""
    cost, above = flight.disagreement(flight.origins, flight.turns)
    noise = config.lidar.range_noise
    sound = above <= MOST_ABOVE and flight.used().mean() > IN_RANGE
    apart = not np.isfinite(cost)  # no common ground: only a unit of the poses can explain that
    if sound and (cost <= NOISES * noise or apart and np.isnan(flight.unit_of_heights())):
        return None
    best, least = None, np.inf
    for correction in _list_corrections(flight, config, tf_mounts):
        fault, origins, turns, scale = correction
        if sound and apart and fault.key != "pose_units":
            continue
        if flight.used(scale).mean() <= IN_RANGE:
            continue
        if sound and scale != 1.0 and cost < 30.0 * noise:
            continue
        left, over = flight.disagreement(origins, turns, scale)
        if fault.key == "map_cloud":
            over = float(np.mean(flight.points[:, 2] > flight.positions[flight.scan, 2]))
        if over <= CORRECTED_ABOVE and left < 0.8 * least:
            best, least = fault, left
    said = [f"{100 * above:.0f} % of the ground lies above the lidar"] * (above > MOST_ABOVE)
    if best is not None and (not sound or least < BETTER * cost):
        far = f"by {cost:.2g} m" if np.isfinite(cost) else "entirely"
        said.append(f"scans disagree {far}, and by {least:.2g} m without this fault")
        return best._replace(text=f"{best.text}: {', '.join(said)}")
    if not said:
        return None
    return Finding("above", said[0], "check frames and axes (docs/connecting.md)")


def _find_tilt(flight: Flight) -> list[Finding]:
    """Find a mean slope that is rather one of the map's axes."""
    used = flight.used()
    if used.mean() <= IN_RANGE:
        return []
    scan = flight.scan[used]
    placed = np.einsum("nij,nj->ni", flight.turns[scan], flight.points[used]) + flight.origins[scan]
    normal = np.linalg.eigh(np.cov(placed.T))[1][:, 0]
    slope = float(np.degrees(np.arccos(min(abs(normal[2]), 1.0))))
    if slope < STEEP_DEG:
        return []
    text = f"the ground slopes by {slope:.0f} deg on average; if it does not, z of the map is not"
    text += " up, as with an odometry that starts with the lidar's first attitude (camera_init):"
    text += " align that with gravity, or with its IMU, and run it on the recording again"
    return [Finding("tilt", text)]


def _find_lag(flight: Flight, period: float) -> list[Finding]:
    """Find a constant delay between clouds and poses that brings the scans together."""
    chosen = (flight.times > -LAGS[0]) & (flight.times < flight.last - LAGS[-1])
    if np.count_nonzero(chosen) < 3:
        return []
    costs = [flight.disagreement_with_lag(lag, chosen) for lag in LAGS]
    cost, near = costs[len(LAGS) // 2], LAGS[int(np.argmin(costs))] + FINER_LAGS
    costs = [flight.disagreement_with_lag(lag, chosen) for lag in near]
    least, lag = min(costs), float(near[int(np.argmin(costs))])
    alone = flight.scatter_alone()
    if not alone < cost < np.inf or abs(lag) < LEAST_LAG or least > GAIN * cost:
        return []
    gain = f"scans disagree by {cost:.2g} m, and by {least:.2g} m with the poses of then"
    if 0.0 < lag < period and least > SWEPT * alone:
        text = f"points have no times, and those of a scan span about {2.0 * lag:.2g} s: {gain}"
        return [
            Finding("times_missing", text, "send the time of each point (docs/messages/inputs.md)")
        ]
    when = "late" if lag < 0.0 else "early"
    text = f"clouds are stamped {abs(lag):.2f} s too {when} against the poses: {gain}"
    fix = f"add {lag:+.2f} s to the clouds' stamps (the driver's time offset), or correct those of"
    return [Finding("lag", text, f"{fix} the poses", lag_s=lag)]


def _find_mount_angle(flight: Flight, config: Config) -> list[Finding]:
    """Find the turn of the lidar about two axes across its view with which scans agree best."""
    if config.mount.source == "gimbal":
        return []
    across = np.linalg.svd(flight.points.mean(axis=0)[None])[2][1:]

    def disagreement(angles: Array) -> float:
        return flight.disagreement(flight.origins, flight.turns @ exp(angles @ across))[0]

    calm = np.radians(CALM_DEG)
    cost, *costs = (
        disagreement(calm * np.array(a)) for a in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    )
    if not np.isfinite(cost):
        return []
    simplex = calm * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    how = {"initial_simplex": simplex, "maxfev": ATTEMPTS, "xatol": 1e-3, "fatol": 0.01 * cost}
    fit = minimize(disagreement, simplex[0], method="Nelder-Mead", options=how)
    angle, turn = float(np.degrees(np.linalg.norm(fit.x))), exp(fit.x @ across)
    alone = flight.scatter_alone()
    if angle < LEAST_DEG or fit.fun > GAIN * cost or cost < alone:
        if min(max(costs[:2]), max(costs[2:])) * GAIN > max(cost, alone):
            return []
        text = "the lidar turns too little to find a short lag, or a mount that is off by"
        text += f" {CALM_DEG:g} deg: turn and sway the vehicle while you record"
        return [Finding("calm", text)]
    mount = flight.mounts[0] @ turn @ cloud_rotation(config.mount).T
    values = mount_values(flight.arms[0], mount, digits=1)
    text = f"the lidar looks {angle:.1f} deg off its mount: scans disagree by {cost:.2g} m, and by"
    text += f" {fit.fun:.2g} m without that"
    if config.mount.source == "tf":
        return [make_setting("mount_angle", text, {"mount.source": "fixed", **values})]
    angles = {name: value for name, value in values.items() if name.endswith("_deg")}
    return [make_setting("mount_angle", text, angles)]
