# SPDX-License-Identifier: Apache-2.0
"""Messages and states of which parts are spoilt: denormals, extremes, lies about sizes."""

from __future__ import annotations

import array
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from messages import samples

from quadtree_lss.lab.simulation.recording import Messages

WHOLE = [0, 1, 2, 3, 4, 7, 8, 12, 16, 255, 2**16, 2**22, 2**22 + 1, 2**31 - 1, 2**31, 2**32 - 1]
NUMBERS = [0.0, -0.0, 1.0, -1.0, 2.0**0.5, math.inf, -math.inf, math.nan]
POWERS = (-320, -200, -160, -44, -9, 7, 9, 12, 38, 160)
NUMBERS += [sign * 10.0**n for n in POWERS for sign in (1, -1)]
NUMBERS += [5e-324, 1.7e308, -1.7e308, 3.4e38]
NAMES = ["x", "y", "z", "t", "time", "range", "azimuth", "elevation", "", "x\n\x1b[2J", "q" * 10**5]
FRAMES = ["map", "/map", "", "odom\nERROR all is well", "\x1b]0;title\x07", "m" * 10**6, "\u202e"]
CONTAINERS = [np.asarray, bytes, lambda data: array.array("B", bytes(data))]
WORDS = [*NAMES, *FRAMES, "body", "lidar", "a", "rgb8", "8UC1", "32FC1", "equidistant"]
KINDS = [("f4",) * 3, ("f8",) * 3, ("f4", "f8", "f4")]


class Types(dict[str, Any]):
    """Message classes that take anything."""

    def __missing__(self, name: str) -> Any:
        return SimpleNamespace


GOOD = Messages(Types())


def one_of(rng: np.random.Generator, among: Sequence[Any]) -> Any:
    return among[rng.integers(len(among))]


def extreme(rng: np.random.Generator) -> float:
    """A number as it stands in no good message, or a usual one of any size."""
    if rng.random() < 0.6:
        return float(one_of(rng, NUMBERS))
    return float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-25, 25))


@np.errstate(over="ignore", invalid="ignore")  # what is written may not fit its type
def random_cloud(rng: np.random.Generator, stamp_ns: int) -> SimpleNamespace:
    """A well-formed cloud with up to two of its parts spoilt."""
    shape = (int(rng.integers(1, 5)), int(rng.integers(1, 6)), 3)
    points = rng.normal(scale=one_of(rng, [1.0, 10.0, 100.0, 1e7]), size=shape)
    points[rng.random(shape) < 0.1] = extreme(rng)
    names = ("x", "y", "z") if rng.random() < 0.7 else ("range", "azimuth", "elevation")
    times = None
    if rng.random() < 0.3:
        kind = one_of(rng, ["u4", "i4", "f4", "f8"])
        late = one_of(rng, [0.0, 1e-320, 1.0, 1e8, 1e18]) * rng.random(shape[:2])
        times = (one_of(rng, ["t", "time", "timestamp"]), kind, late.astype(kind))
    cloud = samples.cloud(
        points,
        names=names,
        kinds=one_of(rng, KINDS),
        order=one_of(rng, ["<", ">"]),
        lead=int(rng.integers(0, 4)),
        gap=int(rng.integers(0, 5)),
        row_padding=int(rng.integers(0, 9)),
        stamp_ns=stamp_ns if rng.random() < 0.9 else int(rng.integers(0, 2**31)) * 10**9,
        container=one_of(rng, CONTAINERS),
        times=times,
    )
    return spoilt(cloud, rng)


def cut(data: Any, rng: np.random.Generator) -> bytes:
    """The first of some bytes, and others behind them."""
    end = int(rng.integers(0, len(data) + 1))
    return bytes(data)[:end] + bytes(rng.integers(0, 256, rng.integers(0, 9), dtype=np.uint8))


def spoil(message: SimpleNamespace, rng: np.random.Generator) -> None:
    """Change one value at any depth of a message to another value of its type."""
    name = one_of(rng, [key for key in vars(message) if key != "sec"])
    value = getattr(message, name)
    if isinstance(value, SimpleNamespace):
        spoil(value, rng)
    elif isinstance(value, list) and value and isinstance(value[0], SimpleNamespace):
        parts = [SimpleNamespace(**vars(part)) for part in value]
        place = int(rng.integers(len(parts)))
        if rng.random() < 0.3:
            parts = parts[:place] + parts[place + rng.integers(2) :] * 2
        else:
            spoil(parts[place], rng)
        setattr(message, name, parts)
    else:
        setattr(message, name, other_value(name, value, rng))


def other_value(name: str, value: Any, rng: np.random.Generator) -> Any:
    """A value of the same type that a publisher may send but should not."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return one_of(rng, WORDS)
    if isinstance(value, int):
        return one_of(rng, WHOLE)
    if isinstance(value, float):
        return extreme(rng)
    if np.asarray(value).dtype.kind != "f":
        size = len(value)
        made = rng.integers(0, 256, size, dtype=np.uint8) if rng.random() < 0.5 else None
        content = cut(value, rng) if made is None else made.tobytes()
        return array.array("b" if getattr(value, "typecode", "") == "b" else "B", content)
    values = np.array(value)
    if name in ("covariance", "d") and rng.random() < 0.3:
        return np.full(one_of(rng, [0, 4, 5, 8, 14, 35, 36, 37]), extreme(rng))
    if rng.random() < 0.3:
        with np.errstate(over="ignore", invalid="ignore"):
            return values * 10.0 ** rng.uniform(-320, 30)
    if values.size:
        values[rng.integers(values.size)] = extreme(rng)
    return values


def spoilt(message: SimpleNamespace, rng: np.random.Generator, most: int = 2) -> SimpleNamespace:
    """The message with up to ``most`` of its values changed."""
    for _ in range(rng.integers(0, most + 1)):
        spoil(message, rng)
    return message


def random_pose(rng: np.random.Generator, good: SimpleNamespace) -> SimpleNamespace:
    """A good pose, or one with any turn, place and covariance, with up to three parts spoilt."""
    pose = good
    if rng.random() < 0.5:
        turn = rng.normal(size=4)
        root = rng.normal(size=(6, 6)) * one_of(rng, [1e-160, 1e-6, 1e-2, 1.0, 1e4])
        pose = samples.pose(
            stamp_ns=good.header.stamp.sec * 10**9 + good.header.stamp.nanosec,
            position=rng.normal(scale=one_of(rng, [1e-300, 10.0, 1e3, 1e7]), size=3),
            xyzw=turn / np.linalg.norm(turn),
            covariance=root @ root.T,
        )
    return spoilt(pose, rng, 3)


def random_transform(rng: np.random.Generator, stamp_ns: int) -> SimpleNamespace:
    """Body to lidar, with up to two parts spoilt."""
    turn = rng.normal(size=4)
    turn /= np.linalg.norm(turn)
    return spoilt(samples.transform(stamp_ns, rng.normal(size=3).tolist(), turn.tolist()), rng)


def random_image(rng: np.random.Generator, stamp_ns: int, z: np.ndarray) -> SimpleNamespace:
    """A depth image of z (H, W), m, with up to two of its parts spoilt."""
    height, width = z.shape
    kinds = [("16UC1", "u2", 1e-3), ("mono16", "u2", 1e-3), ("32FC1", "f4", 1.0)]
    name, kind, unit = one_of(rng, kinds)
    order, padding = one_of(rng, ["<", ">"]), int(rng.integers(0, 3))
    z = z.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        if rng.random() < 0.5:
            z[rng.random(z.shape) < one_of(rng, [0.02, 0.5, 1.0])] = extreme(rng)
        whole = np.zeros((height, width + padding), order + kind)
        whole[:, :width] = np.nan_to_num(z / unit) if kind == "u2" else z
    image = SimpleNamespace(
        header=samples.header(stamp_ns, "camera"),
        height=height,
        width=width,
        encoding=name,
        is_bigendian=int(order == ">"),
        step=whole.strides[0],
        data=one_of(rng, CONTAINERS)(whole.view(np.uint8).ravel()),
    )
    return spoilt(image, rng)


def accepted_pose(
    rng: np.random.Generator, stamp_ns: int, place: tuple[float, float, float]
) -> SimpleNamespace:
    """A pose near upright of which only the covariance is odd: huge, tiny, singular, or of a turn
    about a place on the ground, of which nothing is then uncertain."""
    if rng.random() < 0.5:
        x, y = rng.integers(0, 32, 2) * 0.5 + 0.25 - place[:2]
        about = np.array([[0.0, place[2], y], [-place[2], 0.0, -x], [-y, x, 0.0]])
        root = np.vstack([about, np.eye(3)]) @ rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-8, 0)
        root *= rng.random(3) < 0.7
        covariance = root @ root.T
        covariance[range(3), range(3)] += 10.0 ** rng.uniform(-30, 12, 3) * (rng.random(3) < 0.3)
    elif rng.random() < 0.5:
        root = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-8, 6, (6, 1))
        root *= rng.random((6, 1)) < 0.8
        covariance = root @ root.T
    else:
        covariance = np.diag(10.0 ** rng.uniform(-20, 12, 6))
    most = covariance[3:, 3:].diagonal().max()
    if most > 0.25:  # nothing can be placed by it
        scale = np.repeat([1.0, 0.5 * rng.random() / np.sqrt(most)], 3)
        covariance *= np.outer(scale, scale)
    turn = np.array([1.0, 0.0, 0.0, 0.0]) + one_of(rng, [0, 1e-3, 0.05]) * rng.normal(size=4)
    turn /= np.linalg.norm(turn)
    return samples.pose(stamp_ns, place, turn.tolist(), 0.5 * (covariance + covariance.T))


def random_polygon(rng: np.random.Generator) -> SimpleNamespace:
    """Any number of corners anywhere."""
    count = int(one_of(rng, [0, 1, 2, 3, 3, 4, 4, 5, 9, 1000, 1001]))
    corners = 8.0 + rng.normal(scale=10.0 ** rng.uniform(-3, 2), size=(count, 2))
    if count and rng.random() < 0.5:
        corners[rng.random((count, 2)) < 0.3] = extreme(rng)
    if rng.random() < 0.2:
        corners[:] = corners[:1]
    points = [SimpleNamespace(x=x, y=y, z=extreme(rng)) for x, y in corners.tolist()]
    return SimpleNamespace(
        header=samples.header(0, one_of(rng, ["map"] * 9 + FRAMES)),
        polygon=SimpleNamespace(points=points),
    )


def random_keep_out(rng: np.random.Generator) -> SimpleNamespace:
    """One of a set."""
    polygon = random_polygon(rng)
    number = int(one_of(rng, WHOLE) if rng.random() < 0.1 else rng.integers(0, 300))
    numbered = SimpleNamespace(polygon=polygon.polygon, id=number)
    return SimpleNamespace(header=polygon.header, polygon=numbered)


def random_target(rng: np.random.Generator) -> SimpleNamespace:
    x, y = (extreme(rng) if rng.random() < 0.5 else rng.normal(8.0, 9.0) for _ in range(2))
    frame = one_of(rng, ["map"] * 9 + FRAMES)
    place = samples.xyz((x, y, extreme(rng)))
    return SimpleNamespace(header=samples.header(0, frame), point=place)


def random_dispersion(rng: np.random.Generator) -> SimpleNamespace:
    pose = samples.pose(covariance=np.diag(rng.exponential(4.0, 6)))
    pose = random_pose(rng, pose) if rng.random() < 0.5 else pose
    if len(pose.pose.covariance) == 36:
        for place in (0, 7, 35):
            if rng.random() < 0.4:
                pose.pose.covariance[place] = abs(extreme(rng))
    return pose


def random_of_autopilot(rng: np.random.Generator, mav: Any, now_ns: int) -> Any:
    """A message of a vehicle, of MAVLink, with up to three of its fields spoilt."""
    ms, place, speed = now_ns // 10**6, (1.0, 2.0, -9.0), (0.5, 0.0, 0.1)
    upper, turn = [0.01] + 20 * [0.0], [1.0, 0.0, 0.0, 0.0]
    for first in (6, 11, 15, 18, 20):
        upper[first] = 1e-3
    message = one_of(
        rng,
        [
            mav.MAVLink_heartbeat_message(2, one_of(rng, [3, 12]), 129, 4, 4, 3),
            mav.MAVLink_timesync_message(now_ns + 10**9, now_ns - 10**5),
            mav.MAVLink_extended_sys_state_message(0, 2),
            mav.MAVLink_statustext_message(6, b"text"),
            mav.MAVLink_param_value_message(b"NAME", 1.0, 9, 1, 0),
            *[mav.MAVLink_local_position_ned_message(ms % 2**32, *place, *speed)] * 2,
            *[mav.MAVLink_attitude_quaternion_message(ms % 2**32, *turn, 0.0, 0.0, 0.0)] * 2,
            *[
                mav.MAVLink_odometry_message(
                    now_ns // 1000, 1, 12, *place, turn, *speed, 0.0, 0.0, 0.0, upper, upper
                )
            ]
            * 4,
        ],
    )
    for _ in range(rng.integers(0, 4)):
        name = one_of(rng, message.fieldnames)
        value = getattr(message, name)
        if isinstance(value, list):
            value[rng.integers(len(value))] = as_single(extreme(rng))
        elif isinstance(value, float):
            setattr(message, name, as_single(extreme(rng)))
        elif isinstance(value, int):
            kind = message.fieldtypes[message.fieldnames.index(name)]
            bits = 8 if "char" in kind or "int8" in kind else int(kind.strip("uint_"))
            whole = int(one_of(rng, [*WHOLE, 2**63 - 1, 2**64 - 1])) % 2**bits
            setattr(message, name, whole - 2**bits * (kind[0] != "u" and whole >= 2 ** (bits - 1)))
    return message


@np.errstate(over="ignore", under="ignore")
def as_single(value: float) -> float:
    return float(np.float32(value))


def spoil_values(values: np.ndarray, rng: np.random.Generator) -> None:
    """Some or all of an array of numbers, in place."""
    if not values.size:
        return
    where = rng.random(values.shape) < one_of(rng, [0.01, 0.3, 1.0])
    where.reshape(-1)[rng.integers(values.size)] = True
    with np.errstate(all="ignore"):
        if values.dtype.kind == "f":
            by = extreme(rng)
            many = np.count_nonzero(where)
            old = values[where]
            values[where] = one_of(rng, [np.full(many, by), old * by, old + by, -old])
        else:
            values[where] = np.array(one_of(rng, WHOLE)).astype(values.dtype)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, cut out, cut off, or doubled."""
    whole = np.frombuffer(content, dtype=np.uint8).copy()
    place = int(rng.integers(len(whole)))
    end = min(place + int(2 ** rng.uniform(0, 12)), len(whole))
    kind = rng.integers(4)
    if kind == 0:
        whole[place:end] ^= rng.integers(1, 256, end - place, dtype=np.uint8)
    elif kind == 1:
        whole = np.delete(whole, slice(place, end))
    elif kind == 2:
        whole = whole[:place]
    else:
        whole = np.insert(whole, place, whole[place:end])
    return whole.tobytes()
