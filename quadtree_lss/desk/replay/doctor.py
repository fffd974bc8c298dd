# SPDX-License-Identifier: Apache-2.0
"""Faults of clouds and poses, and the setting that fixes each.

Frames, axes, units, lag and mount are judged by the ground: scans that are placed right lie below
the lidar and agree with each other. Each common fault is corrected in turn. A fault is claimed only
if scans disagree with it and agree clearly better without.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from quadtree_lss.desk.replay.heard import IN_RANGE, Finding, Flight, Heard, of_lidar, setting
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, MountConfig
from quadtree_lss.onboard.core.geometry.rotations import (
    exp,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import AXES, cloud_turn
from quadtree_lss.onboard.messages.lost_points import LOOKING_DOWN, NED_FROM_ENU

BETTER, NOISES = 0.4, 3.0
"""What is mended must be so much better, and what there is worse than the noise by this."""
ALIKE = 10.0
"""Scans that see no common ground must see it so well when mended, in deviations of the noise."""
MOST_ABOVE, MENDED_ABOVE = 0.5, 0.05
"""Share of points above the lidar: of houses about one that stands, and of what is mended."""
LAGS, FINER = np.linspace(-0.5, 0.5, 21), np.linspace(-0.04, 0.04, 9)
LEAST_LAG, LAG_GAIN = 0.03, 0.8
"""s; and the share of the disagreement that is left without the lag."""
LEVEL_DEG, LEAST_DEG, SURE = 3.0, 2.0, 3.0
"""Of ground: how far from level it may be on the whole; of a mount: what is no error; sigmas."""
CALM_DEG = 5.0
"""A flight is too calm if by it a mount that is so far off is not found."""
GROUNDS = 5.0
"""Independent grounds that a flight sees: neighbouring scans see the same slopes."""
FLIP = np.diag([1.0, -1.0, -1.0])
JUMPY = 0.3
"""Share of the range. Scans without common ground disagree if their heights scatter by more."""
STEEP_DEG = 12.0
"""A common slope that is rather a map whose z axis is not up."""
FAR_M = 1e5
"""Beyond it places are those of a geographic grid."""
ZIGZAG = 5.0
"""Poses alternate between two paths if they leap by so many of their steps."""


def findings(heard: Heard, config: Config, *, timed: bool = True) -> list[Finding]:
    """Findings from the messages and the ground. ``timed``: the points' times, if any, are known;
    otherwise no lag is judged."""
    found = _path_findings(heard)
    flight = heard.flight(config)
    if flight is None:
        return found
    return found + _judged(flight, config, heard.tf_mounts, timed=timed)


def _path_findings(heard: Heard) -> list[Finding]:
    """Poses of two publishers on one topic, and of a geographic grid."""
    places = np.array([place for _, place, _ in sorted(heard.poses, key=lambda pose: pose[0])])
    if len(places) < 8:
        return []
    leap = np.linalg.norm(places[1:-1] - 0.5 * (places[:-2] + places[2:]), axis=1)
    leap_m, step_m = np.median(leap), np.median(np.linalg.norm(places[2:] - places[:-2], axis=1))
    if leap_m > max(ZIGZAG * step_m, 0.05):
        text = f"poses alternate between two paths {leap_m:.2g} m apart: two publishers?"
        return [Finding("two_paths", text, "record each on its own topic, choose one of them")]
    x, y, _ = np.median(places, axis=0)
    if max(abs(x), abs(y)) < FAR_M:
        return []
    text = f"poses are about x {x:.0f}, y {y:.0f} m, as of UTM: the domain has to lie there"
    text += " (config suggest writes it), and so will the results"
    return [Finding("far", text)]


class _Try(NamedTuple):
    """A fault, and where the lidar was without it."""

    fault: Finding
    origins: Array
    turns: Array
    scale: float = 1.0


MAP_CLOUD = (
    "clouds are in the map's frame already",
    "choose those in the lidar's own axes by --scan-topic (of FAST-LIO /cloud_registered_body), or"
    " write the clouds to files and replay these: without --poses they are taken as of the map",
)
NO_MOUNT = {f"mount.{name}": value for name, value in asdict(MountConfig()).items()}


def _tries(flight: Flight, config: Config, tf_mounts: Mapping[str, Pose]) -> list[_Try]:
    """The common faults; of those that explain the scans equally well the first is the likelier."""
    p, b, m, at = flight.places, flight.body, flight.mounts, flight.origins
    own = m @ cloud_turn(config.mount).T
    tries = []
    for frame, mount in tf_mounts.items():
        text = f"poses are of '{frame}', on which /tf_static has the lidar"
        fault = setting("mount_tf", text, {"mount.source": "tf", "frames.body": frame})
        arm, turn = np.broadcast_to(mount.position, p.shape), mount.rotation_map_lidar
        tries.append(_Try(fault, *of_lidar(p, b, arm, np.broadcast_to(turn, b.shape))))
    for name, turn in AXES.items():
        if name != config.mount.axes:
            text = f"clouds and poses are of different axes ({name.replace('_', ' ')})"
            fault = setting("axes", text, {"mount.axes": name})
            tries.append(_Try(fault, at, b @ own @ turn))
    if not np.allclose(own, np.eye(3)):
        text = "poses are the lidar's own, and a mount is set"
        keep = {**NO_MOUNT, "mount.axes": config.mount.axes}
        fault = Finding("mount", text, "leave out mount.*", settings=keep)
        if config.mount.source == "tf":
            fault = Finding("mount", "poses are the lidar's own", "correct their child frame")
        tries.append(_Try(fault, p, b @ cloud_turn(config.mount)))
    if config.mount.source == "fixed":
        text = "poses are a level body's, and the lidar looks down from it"
        for name, turn in (("roll_deg", LOOKING_DOWN), ("pitch_deg", exp([0.0, np.pi / 2, 0.0]))):
            values = {f"mount.{name}": 180.0 if name == "roll_deg" else 90.0}
            tries.append(_Try(setting("mount", text, values), at, b @ own @ turn))
    text = "poses are in north, east, down; the map is east, north, up"
    mend = "convert them (docs/connecting.md), or take autopilot_node's or MAVROS's nav/odometry"
    ned, fault = NED_FROM_ENU, Finding("ned", text, mend)
    north = [
        _Try(fault, *of_lidar(p @ ned.T, ned @ b @ body, flight.arms, m))
        for body in (np.eye(3), FLIP)
    ]
    tries = north + tries if np.median(p[:, 2]) < 0.0 else tries + north
    mend = "exchange them: x, y, z, w = q[1], q[2], q[3], q[0]"
    first = rotation_from_quaternion(quaternion_from_rotation(b)[:, [1, 2, 3, 0]])
    tries.append(_Try(Finding("quaternion", "orientations have w first", mend), at, first @ m))
    text = "orientations take the map's axes to the lidar's, not back"
    fault = Finding("inverse", text, "publish their inverse: -x, -y, -z, w")
    tries.append(_Try(fault, p, b.transpose(0, 2, 1) @ m))
    for scale, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        mend = f"publish metres: x, y, z times {scale:g}"
        fault = Finding("units", f"clouds are in {unit}", mend)
        tries.append(_Try(fault, at, b @ m, scale))
        mend = f"publish metres: positions times {scale:g}"
        fault = Finding("pose_units", f"poses are in {unit}", mend)
        tries.append(_Try(fault, scale * p + at - p, b @ m))
    here = np.tile(np.eye(3), (len(p), 1, 1))
    return [*tries, _Try(Finding("map_cloud", *MAP_CLOUD), np.zeros_like(p), here)]


def _judged(
    flight: Flight, config: Config, tf_mounts: Mapping[str, Pose], *, timed: bool
) -> list[Finding]:
    """Findings from the ground: axes, frames, units, own returns, lag and mount."""
    fault, own = _common_fault(flight, config, tf_mounts), None
    if fault is None and (own := flight.leave_out_own()) is not None:
        fault = _common_fault(flight, config, tf_mounts)
    found = [] if own is None else [own]
    if fault is not None:
        return [*found, fault]
    return [*found, *((timed and _lag(flight)) or _mount(flight, config)), *_tilt(flight)]


def _common_fault(flight: Flight, config: Config, tf_mounts: Mapping[str, Pose]) -> Finding | None:
    """The fault of axes, frames or units without which scans agree clearly better, if they
    disagree with it."""
    cost, above = flight.disagreement(flight.origins, flight.turns)
    noise = config.lidar.range_noise
    sound = above <= MOST_ABOVE and flight.used(1.0).mean() > IN_RANGE
    disagrees = cost > NOISES * noise if np.isfinite(cost) else flight.scatter() > JUMPY
    limit = BETTER * cost if np.isfinite(cost) else ALIKE * noise
    if sound and not disagrees:
        return None
    best: tuple[float, _Try] | None = None
    for tried in _tries(flight, config, tf_mounts):
        if flight.used(tried.scale).mean() <= IN_RANGE:
            continue
        if sound and tried.scale != 1.0 and cost < 30.0 * noise:
            continue
        left, over = flight.disagreement(tried.origins, tried.turns, tried.scale)
        if tried.fault.key == "map_cloud":
            over = float(np.mean(flight.points[:, 2] > flight.places[flight.of, 2]))
        if over <= MENDED_ABOVE and (best is None or left < 0.8 * best[0]):
            best = left, tried
    if best is not None and np.isfinite(best[0]) and (not sound or best[0] < limit):
        fault = best[1].fault
        return fault._replace(text=f"{fault.text}: {_state(cost, above, best[0])}")
    if above <= MOST_ABOVE:
        return None
    text = f"{100 * above:.0f} % of the ground lies above the lidar"
    mend = "look at frames and axes (docs/connecting.md): no common fault explains it"
    return Finding("above", text, mend)


def _tilt(flight: Flight) -> list[Finding]:
    """Ground with a slope that is rather the map's."""
    used = flight.used(1.0)
    of = flight.of
    placed = np.einsum("nij,nj->ni", flight.turns[of], flight.points) + flight.origins[of]
    placed = placed[used] - placed[used].mean(axis=0)
    normal = np.linalg.svd(placed[:: max(len(placed) // 4000, 1)], full_matrices=False)[2][2]
    slope = float(np.degrees(np.arccos(min(abs(normal[2]), 1.0))))
    if slope < STEEP_DEG:
        return []
    text = f"the ground slopes by {slope:.0f} deg on the whole: if it does not, z of the map is not"
    text += " up, as with an odometry that begins with the lidar's first attitude (camera_init);"
    text += " align that with gravity, or with its IMU, and run it on the recording again"
    return [Finding("tilt", text)]


def _state(cost: float, above: float, mended: float) -> str:
    words = [f"{100 * above:.0f} % of the ground lies above the lidar"] * (above > MOST_ABOVE)
    if np.isfinite(mended):
        far = f"{cost:.2g} m" if np.isfinite(cost) else "not at all"
        words.append(f"mended, scans agree to {mended:.2g} m, and as it is {far}")
    return ", ".join(words)


def _lag(flight: Flight) -> list[Finding]:
    """A constant delay between clouds and poses that brings the scans together."""
    chosen = (flight.times > -LAGS[0]) & (flight.times < flight.last - LAGS[-1])
    if np.count_nonzero(chosen) < 3:
        return []
    costs = np.array([flight.late(lag, chosen) for lag in LAGS])
    now, near = costs[len(LAGS) // 2], LAGS[int(np.argmin(costs))] + FINER
    costs = np.array([flight.late(lag, chosen) for lag in near])
    best = int(np.argmin(costs))
    lag = float(near[best])
    if not (np.isfinite(now) and abs(lag) >= LEAST_LAG and costs[best] < LAG_GAIN * now):
        return []
    late = "late" if lag < 0.0 else "early"
    text = f"clouds are stamped {abs(lag):.2f} s too {late} against the poses: scans agree to"
    text += f" {costs[best]:.2g} m with the poses of then, to {now:.2g} m with those of their stamp"
    mend = f"add {lag:+.2f} s to the clouds' stamps (the driver's time offset), or correct the"
    mend += " poses'; if a scan takes so long, send a time with each point instead"
    return [Finding("lag", text, mend)]


def _mount(flight: Flight, config: Config) -> list[Finding]:
    """Roll and pitch of the mount by which the ground keeps its slope, and is about level.

    Unknown are a small turn d of the lidar about two axes across the ground's normal and the
    ground's own normal n. Each scan k, whose normal is m_k in lidar axes, says R_k exp(d) m_k = n.
    """
    if config.mount.source == "gimbal":
        return []
    seen = flight.normals.any(axis=1)
    turns, normals = flight.turns[seen], flight.normals[seen]
    upward = np.sign(np.einsum("ki,ki->k", turns[:, 2, :], normals))
    normals = normals * np.where(upward == 0.0, 1.0, upward)[:, None]
    middle = normals.mean(axis=0)
    middle /= np.linalg.norm(middle)
    across = np.linalg.svd(middle[None])[2][1:]  # two axes

    def residuals(unknown: Array) -> Array:
        tilt = np.array([unknown[2], unknown[3], 1.0])
        told = np.einsum("kij,kj->ki", turns @ exp(unknown[:2] @ across), normals)
        return np.asarray(told - tilt / np.linalg.norm(tilt))

    deviation = 0.02
    for _ in range(3):  # the slopes' own deviation, and by it the weights
        sigma = deviation * np.sqrt(len(turns) / GROUNDS)

        def weighted(unknown: Array, sigma: float = sigma) -> Array:
            prior = unknown / np.radians([20.0, 20.0, LEVEL_DEG, LEVEL_DEG])
            return np.concatenate([residuals(unknown).ravel() / sigma, prior])

        fit = least_squares(weighted, np.zeros(4))
        deviation = max(1.2 * float(np.median(np.linalg.norm(residuals(fit.x), axis=1))), 0.002)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    angle = float(np.degrees(np.linalg.norm(fit.x[:2])))
    unsure = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
    if angle < max(LEAST_DEG, SURE * unsure):
        if SURE * unsure < CALM_DEG:
            return []
        text = "the flight is too calm to find a short lag, or a lidar that looks"
        text += f" {SURE * unsure:.0f} deg beside where it should: turn and sway the vehicle"
        return [Finding("calm", text)]
    turn = exp(fit.x[:2] @ across)
    there = flight.disagreement(flight.origins, flight.turns @ turn)[0]
    now = flight.disagreement(flight.origins, flight.turns)[0]
    if not np.isfinite(there) or LAG_GAIN * there > now:
        return []  # hills in a long narrow view: what would correct a mount takes the scans apart
    mount = flight.mounts[0] @ turn @ cloud_turn(config.mount).T
    angles = np.round(Rotation.from_matrix(mount).as_euler("xyz", degrees=True), 1)
    roll, pitch, yaw = np.where(angles == -180.0, 180.0, angles)
    text = f"the lidar looks {angle:.1f} deg ({unsure:.1f}) beside where its mount says: the ground"
    text += " turns with the vehicle, or is far from level"
    if config.mount.source == "tf":
        mend = f"correct /tf_static: roll, pitch, yaw {roll:.1f}, {pitch:.1f}, {yaw:.1f} deg"
        return [Finding("mount_angle", text, mend)]
    values = {"mount.roll_deg": roll, "mount.pitch_deg": pitch, "mount.yaw_deg": yaw}
    return [setting("mount_angle", text, {k: float(v) for k, v in values.items()})]
