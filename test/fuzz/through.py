# SPDX-License-Identifier: Apache-2.0
"""Every input through its decoder to what works with it, and on to what is sent.

Of each case is said what became of it: taken, or refused by which reason. What is taken must leave
a sound map and sound sites, in numbers that the messages can hold.
"""

from __future__ import annotations

import faulthandler
import io
import resource
import socket
import warnings
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from pathlib import Path
from select import select
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from core.builders import assert_sound, configured
from core.scenes import make_pose, scan, scattered
from fuzz import cases
from fuzz.cases import extreme, one_of
from messages import samples

from quadtree_lss.onboard.autopilot import landing as autopilot
from quadtree_lss.onboard.autopilot.controller import Controller
from quadtree_lss.onboard.autopilot.frames import Nav
from quadtree_lss.onboard.autopilot.inputs import Inputs, Target, target_from_status
from quadtree_lss.onboard.autopilot.link import ARDUPILOT, PX4
from quadtree_lss.onboard.config.limits import assessment_seconds
from quadtree_lss.onboard.config.sections import AutopilotConfig
from quadtree_lss.onboard.config.settings import Config, ConfigError, config_from_values, parameters
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.pose_gate import MAX_SUSPECT_POSES
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError, from_file, to_bytes
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.landing_inputs import (
    LandingRequests,
    name_of,
    polygon_from_message,
)
from quadtree_lss.onboard.messages.maps import CELL_FIELDS, STATUS_FIELDS
from quadtree_lss.onboard.messages.outputs import (
    MessageMaker,
    map_from_messages,
    status_from_message,
)

TAKEN = "taken"
HEIGHT = 25.0
LANDING = {"grid_spacing": 1.0, "sites": 3, "dispersion": 0.5}
CONFIGS = [
    configured(
        domain={"max_level": 5}, vehicle={"diameter": 2.0}, lss={**LANDING, "assessment": of}
    )
    for of in ("probability", "touchdown", "paper")
]


def packed(values: np.ndarray) -> array[int]:
    out = array(values.dtype.char)
    out.frombytes(values.tobytes())
    return out


MAKER = MessageMaker(cases.Types(), packed, "map")


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.05 * x + 1.0 * (np.hypot(x - 12.0, y - 12.0) < 1.5)


def good_points(rng: np.random.Generator, count: int = 300) -> np.ndarray:
    """(N, 3) in lidar axes, of a lidar over the middle that looks down."""
    pose = make_pose((8.0, 8.0, HEIGHT))
    return scan(ground, *scattered(rng, 0.0, 0.0, 16.0, count), pose, 0.03, rng)


def mapped_scene(config: Config) -> Mapper:
    mapper, rng = Mapper(config), np.random.default_rng(3)
    for k in range(4):
        pose = make_pose((8.0, 8.0, HEIGHT), 1e-6 * np.eye(6), 10**9 + 10**8 * k)
        mapper.update(good_points(rng, 3000), pose)
    return mapper


def judge(cells: CellMap, selector: LandingSiteSelector, **wanted: Any) -> None:
    """Landing on a map, and all that is said of it."""
    found = selector.assess(cells, **wanted)
    domain, sites = cells.domain, found.sites
    assert np.isfinite(sites.position).all() and np.isfinite(sites.normal).all()
    assert np.isfinite(sites.score).all() and np.isfinite(sites.hazard_distance).all()
    for axis, low in enumerate((domain.xmin, domain.ymin)):
        assert (np.abs(sites.position[:, axis] - low - 0.5 * domain.size) <= domain.size).all()
    share = found.probability[np.isfinite(found.probability)]
    assert ((share >= 0.0) & (share <= 1.0)).all()
    for _, message in (*MAKER.of_target(found, 0.0), *MAKER.of_ground(found)):
        assert message is not None
    MAKER.grid_map(found)
    if found.selected.id:
        covariance = found.selected.covariance
        assert np.isnan(covariance).all() or (covariance.diagonal() >= 0.0).all()


def assert_taken_up(mapper: Mapper) -> None:
    """A mapper takes up the checkpoint of any map."""
    content, other = to_bytes(mapper.export_state()), Mapper(mapper.config)
    other.import_state(from_file(io.BytesIO(content)))
    assert to_bytes(other.export_state()) == content


def sent_and_read(cells: CellMap, config: Config) -> CellMap:
    """The map as lss_node has it."""
    (_, cloud), (_, grid) = MAKER.of_map(cells)
    return map_from_messages(cloud, grid, config.lss)


class Mapping:
    """What takes messages in, maps and judges; its own counters are closed."""

    def __init__(self, rng: np.random.Generator, kind: str, values: dict[str, Any]) -> None:
        self.rng, self.kind = rng, kind
        self.config = config_from_values(values, one_of(rng, CONFIGS))
        self.selector = LandingSiteSelector(self.config)
        self.intake, self.mapper = Intake(self.config), Mapper(self.config)
        self.now, self.sent, self.mapped = 10**9, 0, 0

    def work(self, refused: Counter[str], word: str) -> Counter[str]:
        """Maps what is ready; what was refused of it since, by reasons that begin so."""
        notices = self.intake.notices()
        assert all(len(text) < 1100 and text.isprintable() for _, text in notices)
        for scan_ in self.intake.ready(self.now):
            report = self.mapper.update(scan_.points_lidar, scan_.pose, scan_.sweep)
            assert report.points_used + sum(report.dropped.values()) == report.points
            assert min(scan_.lost(report.dropped).values()) >= 0
            self.mapped += 1
        if self.sent % 20 == 0:
            cells = self.mapper.snapshot()
            assert_sound(cells)
            assert_taken_up(self.mapper)
            judge(sent_and_read(cells, self.config), self.selector)
        return self.refused(word) - refused

    def refused(self, word: str) -> Counter[str]:
        """What could not be used so far, by reasons that begin so."""
        return Counter({k: n for k, n in self.intake.rejected.items() if k.startswith(word)})

    def close(self, told: Counter[str]) -> None:
        self.intake.finish()
        assert self.mapped + sum(self.intake.queue.dropped.values()) == self.intake.scans
        assert self.mapped > 0


class Flight(Mapping):
    """mapping_node's part: good scans and poses, and of one kind bad ones among them."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        values = {"mount.source": {"gimbal": "gimbal", "transforms": "tf"}.get(kind, "fixed")}
        values["frames.body"] = "body" if kind == "transforms" else ""
        if kind == "follow":
            values |= {"domain.follow": one_of(rng, ["vehicle", "area"]), "domain.min_level": 3}
        super().__init__(rng, kind, values)
        words = {"odometry": "pose", "follow": "pose", "transforms": "transform"}
        self.word = words.get(kind, kind)

    def send(self) -> str:
        self.sent += 1
        self.now += 10**8
        refused = self.intake.rejected.copy()
        covariance = np.diag([1e-4] * 3 + [1e-8] * 3)
        turn = (1, 0, 0, 0) if self.kind not in ("gimbal", "transforms") else (0, 0, 0, 1)
        pose = samples.pose(self.now, (8.0, 8.0, HEIGHT), turn, covariance)
        if self.kind in ("pose", "odometry", "follow"):
            odd = cases.accepted_pose(self.rng, self.now, (8.0, 8.0, HEIGHT))
            pose = odd if self.rng.random() < 0.3 else cases.random_pose(self.rng, pose)
        area = cases.random_polygon(self.rng) if self.kind == "follow" else None
        if self.kind == "odometry":
            pose.child_frame_id = one_of(self.rng, ["body"] * 9 + cases.FRAMES)
        turned = cases.random_transform(self.rng, self.now)
        cloud = samples.cloud(good_points(self.rng, 60), stamp_ns=self.now)
        if self.kind == "cloud":
            cloud = cases.random_cloud(self.rng, self.now)
        with np.errstate(all="raise", under="ignore"):
            if self.kind == "gimbal":
                self.intake.on_gimbal(turned)
            if self.kind == "transforms":
                count = int(self.rng.integers(0, 4))
                more = [cases.random_transform(self.rng, self.now) for _ in range(count)]
                self.intake.on_transforms(SimpleNamespace(transforms=[turned, *more]))
            if area is not None:
                with suppress(MessageError):
                    self.mapper.set_area(polygon_from_message(area))
            self.intake.on_pose(pose)
            self.intake.on_cloud(cloud, self.now)
        return next(iter(self.work(refused, self.word)), TAKEN)

    def close(self, told: Counter[str]) -> None:
        super().close(told)
        refused = self.refused(self.word).total()
        if self.kind == "cloud":
            assert self.intake.scans + refused == self.sent
        if self.kind in ("pose", "odometry", "follow"):
            assert 0 <= self.sent - self.intake.poses_taken - refused < MAX_SUSPECT_POSES


class Landing:
    """What judges a map, by any rule."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        self.rng, self.kind = rng, kind
        by_risk = kind in ("dispersion", "status")
        self.config = CONFIGS[0] if by_risk else one_of(rng, CONFIGS)
        self.selector = LandingSiteSelector(self.config)
        self.cells = mapped_scene(self.config).snapshot()
        self.requests, self.sent = LandingRequests("map"), 0


class Maps(Landing):
    """lss_node's part: ``map/cells`` or ``map/observed`` spoilt."""

    def send(self) -> str:
        (_, cloud), (_, grid) = MAKER.of_map(self.cells)
        for _ in range(self.rng.integers(1, 4)):
            if self.kind == "observed":
                cases.spoil(grid, self.rng)
            else:
                self.spoil_cells(cloud)
        try:
            with np.errstate(all="raise", under="ignore"):
                cells = map_from_messages(cloud, grid, self.config.lss)
        except MessageError as error:
            assert str(error).isprintable()
            return error.reason
        judge(cells, self.selector)
        return TAKEN

    def spoil_cells(self, cloud: SimpleNamespace) -> None:
        rng, which = self.rng, self.rng.integers(8)
        if which > 5 or not cloud.data or len(cloud.data) % CELL_FIELDS.itemsize:
            cases.spoil(cloud, rng)
            return
        records = np.frombuffer(bytes(cloud.data), CELL_FIELDS).copy()
        if which <= 3:
            cases.spoil_values(records[one_of(rng, CELL_FIELDS.names)], rng)
        elif which == 4:  # another scale
            scale = 10.0 ** rng.uniform(-25, 25)
            with np.errstate(all="ignore"):
                for name in one_of(rng, [["size"], ["size", "x", "y", "z", "elevation"]]):
                    records[name] *= scale
        else:  # leaves twice, exchanged or left out
            records = records[rng.integers(0, len(records), len(records) + rng.integers(-1, 2))]
            cloud.width = len(records)
        cloud.data = array("B", records.tobytes())

    def close(self, told: Counter[str]) -> None:
        assert told[TAKEN] and len(told) > 2, told  # 200 cases contain two reasons at least


class Wishes(Landing):
    """lss_node's part: what guidance says."""

    MAKE: dict[str, Callable[[np.random.Generator], SimpleNamespace]] = {
        "area": cases.random_polygon,
        "keep_out": cases.random_polygon,
        "keep_outs": cases.random_keep_out,
        "target": cases.random_target,
        "dispersion": cases.random_dispersion,
    }

    def send(self) -> str:
        reason, message = TAKEN, self.MAKE[self.kind](self.rng)
        try:
            with np.errstate(all="raise", under="ignore"):
                self.requests.use_message(self.kind, message)
        except MessageError as error:
            assert (
                str(error).isprintable() and name_of(self.kind, message) in self.requests.unusable
            )
            reason = error.reason
        self.sent += 1
        if self.sent % 5 == 0:
            judge(self.cells, self.selector, **self.requests.arguments())
        return reason

    def close(self, told: Counter[str]) -> None:
        assert told[TAKEN] and told["frame"]


class Vehicle:
    """autopilot_node's part: an autopilot's bytes to odometry for the map, and to set-points."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        self.rng = rng
        self.mavlink = mavlink = pytest.importorskip("pymavlink.dialects.v20.all")
        self.now = 10**18
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.there = probe.getsockname()
        config = AutopilotConfig(connection=f"udpin:127.0.0.1:{self.there[1]}")
        self.controller = Controller(config, lambda: self.now, lambda: 1e-9 * self.now)
        self.link = self.controller.link
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.autopilot = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self.intake = Intake(config_from_values({"pose.source": "odometry"}, CONFIGS[0]))
        self.sent = self.poses = self.octets = 0
        self.heard: Counter[str] = Counter()
        parse = self.link._port.mav.parse_char

        def counted(piece: bytes) -> Any:
            message = parse(piece)
            if message is not None:
                self.heard["messages"] += 1
                self.heard["octets"] += len(message.get_msgbuf())
            return message

        self.link._port.mav.parse_char = counted
        kind_of = int(one_of(rng, [PX4, ARDUPILOT]))
        beat = mavlink.MAVLink_heartbeat_message(2, kind_of, 129, 4, 4, 3)
        asked = self.now - 10**5
        self.link._timesync_sent.append(asked)
        for message in (beat, mavlink.MAVLink_timesync_message(self.now - 10**9, asked)):
            self.octets += self.socket.sendto(message.pack(self.autopilot), self.there)

    def send(self) -> str:
        self.sent += 1
        self.now += 10**7
        content = cases.random_of_autopilot(self.rng, self.mavlink, self.now - 10**9)
        content = content.pack(self.autopilot)
        if self.sent % 8 == 0:
            content = cases.damaged(content, self.rng)
        refused, heard = self.link.rejected.copy(), self.link.message_counts.copy()
        if content:
            self.octets += self.socket.sendto(content, self.there)
            select([self.link._port.port], [], [], 60.0)  # the system may take its time
        with np.errstate(all="raise", under="ignore"):
            navs = self.controller.poll()
            for nav in navs:
                self.fly(nav)
        self.poses += len(navs)
        self.intake.notices()
        gone = [*(self.link.rejected - refused), *(self.link.message_counts - heard)]
        return TAKEN if navs else next(iter(gone), "not yet a message")

    def fly(self, nav: Nav) -> None:
        header = samples.pose(nav.stamp_ns, nav.position.tolist(), nav.quaternion.tolist())
        if nav.covariance is not None:
            header.pose.covariance = nav.covariance.ravel()
        header.child_frame_id = "body"
        self.intake.on_pose(header)
        target = Target(np.array([2.0, 1.0, 0.0]), 0.1, 0.1, 0.0)
        order = self.controller.step(target, "")
        if order is not None:
            assert order.point is None or np.isfinite(order.point).all()
            self.link.send_text(order.text, warn=False)
        self.link.send_landing_target(target.place, nav)

    def close(self, told: Counter[str]) -> None:
        """No byte and no message is lost count of, and what was said of the vehicle's poses is what
        the mapping node has of them."""
        port, link = self.link._port, self.link
        assert self.heard["octets"] + port.mav.buf_len() == self.octets
        assert link.message_counts.total() + link.rejected.total() == self.heard["messages"]
        assert link.message_counts["pose"] == self.poses
        self.link.close()
        self.socket.close()
        refused = sum(n for k, n in self.intake.rejected.items() if k.startswith("pose"))
        assert 0 <= self.poses - self.intake.poses_taken - refused < MAX_SUSPECT_POSES
        assert told[TAKEN] and told["damaged"] and len(told) > 3


class Settings:
    """Parameters from declaration to map and sites."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        self.rng = rng
        self.rows = [row for row in parameters() if row.name != "lss.risk_model"]

    def send(self) -> str:
        rng, values = self.rng, {"domain.max_level": int(self.rng.integers(3, 6))}
        values["domain.min_level"] = 2
        values["domain.size"] = float(one_of(rng, [8.0, 16.0, 20.0]))
        few = int(rng.integers(1, one_of(rng, [6, len(self.rows)])))
        for place in rng.integers(0, len(self.rows), few):
            values[self.rows[place].name] = self.value(self.rows[place])
        if isinstance(level := values["domain.max_level"], int):
            values["domain.max_level"] = min(level, 7)  # time, not kinds
        try:
            config = config_from_values(values)
        except ConfigError as error:
            assert str(error).isprintable()
            return "refused"
        mapper, d = Mapper(config), config.domain
        points = d.size / config.lss.spacing
        if max(points, assessment_seconds(d.size, 1 << d.max_level, config.lss) * 1e3) > 1e3:
            return "too slow for thousands"
        middle = np.array([d.xmin + 0.5 * d.size, d.ymin + 0.5 * d.size, HEIGHT])
        for k in range(2):
            pose = make_pose(tuple(middle), 1e-6 * np.eye(6), 10**9 + 10**8 * k)
            points = np.column_stack(
                [*(0.5 * d.size * rng.uniform(-1, 1, (2, 400))), HEIGHT + rng.normal(0, 0.03, 400)]
            )
            mapper.update(points, pose)
        cells = mapper.snapshot()
        assert_sound(cells)
        assert_taken_up(mapper)
        selector = LandingSiteSelector(config)
        for _ in range(2):
            judge(sent_and_read(cells, config), selector)
        return TAKEN

    def value(self, row: Any) -> Any:
        rng = self.rng
        if rng.random() < 0.1:
            return one_of(rng, [None, "text", True, 3, [1.0], {}, "", float("nan"), 10**400])
        if row.choices:
            return one_of(rng, [*row.choices, "none of them"])
        if row.type is bool:
            return bool(rng.integers(2))
        if row.type is str:
            return one_of(rng, cases.NAMES)
        low, high = max(row.low, -1e300), min(row.high, 1e300)
        if row.type is int:
            return int(one_of(rng, [low, high, low + 1, high - 1, rng.integers(low, high + 1)]))
        small = float(np.clip(10.0 ** rng.uniform(-320, 6), low, high))
        between = low + (high - low) * 10.0 ** rng.uniform(-6, 0)
        return float(one_of(rng, [low, high, small, between, extreme(rng)]))

    def close(self, told: Counter[str]) -> None:
        assert told[TAKEN] and told["refused"]


class Checkpoints:
    """A damaged checkpoint: rejected, or read with the content that was written."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        self.rng = rng
        self.config = one_of(rng, CONFIGS)
        self.content = to_bytes(mapped_scene(self.config).export_state())
        self.empty = to_bytes(Mapper(self.config).export_state())

    def send(self) -> str:
        mapper = Mapper(self.config)
        try:
            mapper.import_state(from_file(io.BytesIO(cases.damaged(self.content, self.rng))))
        except CheckpointError as error:
            assert str(error).isprintable()
            assert to_bytes(mapper.export_state()) == self.empty
            return str(error)
        assert to_bytes(mapper.export_state()) == self.content
        return TAKEN

    def close(self, told: Counter[str]) -> None:
        assert len(told) > 1


class Depth(Mapping):
    """mapping_node's part with a depth camera: images, or what is said of them, spoilt."""

    SHAPE, FOCAL = (12, 16), 20.0

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        values = {"lidar.source": "depth"}
        if rng.random() < 0.5:
            values["lidar.stereo_noise"] = 0.1 / (0.05 * self.FOCAL)
        super().__init__(rng, kind, values)
        self.good = cases.GOOD.camera(0, *self.SHAPE, self.FOCAL)
        self.intake.on_camera_info(self.good)
        self.infos = 0

    def send(self) -> str:
        self.sent += 1
        self.now += 10**8
        refused = self.intake.rejected.copy()
        z = HEIGHT - 0.5 + 0.05 * self.rng.normal(size=self.SHAPE)
        with np.errstate(all="raise", under="ignore"):
            if self.kind == "camera_info":
                self.intake.on_camera_info(cases.spoilt(deepcopy(self.good), self.rng))
                image = cases.GOOD.depth(self.now, z)
            else:
                image = cases.random_image(self.rng, self.now, z)
            self.intake.on_pose(samples.pose(self.now, (8.0, 8.0, HEIGHT), (1, 0, 0, 0)))
            self.intake.on_cloud(image, self.now)
        gone = self.work(refused, "camera_info" if self.kind == "camera_info" else "cloud")
        if self.kind == "camera_info":  # what follows is seen by a good one
            self.infos += gone.total()
            self.intake.on_camera_info(self.good)
        return next(iter(gone), TAKEN)

    def close(self, told: Counter[str]) -> None:
        """Images and what is said of them are counted apart, and each is one or the other."""
        super().close(told)
        assert self.intake.scans + self.refused("cloud").total() == self.sent
        assert self.refused("camera").total() == self.infos
        assert sum(self.intake.dropped.values()) == self.sent - self.mapped
        assert told[TAKEN] and len(told) > 1


class LandNow(Landing):
    """lss_node's part: where the vehicle is, and that it has to land."""

    def send(self) -> str:
        rng = self.rng
        self.sent += 1
        good = samples.pose(10**9 + 10**8 * self.sent, (*rng.normal(8.0, 6.0, 2), HEIGHT))
        with np.errstate(all="raise", under="ignore"):
            told = self.requests.navigation.use_pose(cases.random_pose(rng, good))
            if rng.random() < 0.5:
                self.selector.land_now()
            if rng.random() < 0.1:
                self.selector.release()
        if rng.random() < 0.3:
            topic = one_of(rng, list(Wishes.MAKE))
            with suppress(MessageError):
                self.requests.use_message(topic, Wishes.MAKE[topic](rng))
        judge(self.cells, self.selector, **self.requests.arguments())
        return TAKEN if told else "passed over"

    def close(self, told: Counter[str]) -> None:
        assert told[TAKEN] and told["passed over"]


class Told(Landing):
    """autopilot_node's part: ``landing/status`` spoilt, on to set-points."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        super().__init__(rng, kind)
        self.now, self.found = 0.0, self.selector.assess(self.cells)
        self.landing = autopilot.Landing(AutopilotConfig())

    def send(self) -> str:
        rng = self.rng
        (_, _), (_, cloud) = MAKER.of_target(self.found, 0.0)
        if rng.random() < 0.5:
            record = np.frombuffer(bytes(cloud.data), STATUS_FIELDS).copy()
            for _ in range(rng.integers(1, 4)):
                cases.spoil_values(record[one_of(rng, STATUS_FIELDS.names)], rng)
            cloud.data = array("B", record.tobytes())
        elif rng.random() < 0.3:  # none, or more than one
            count = int(one_of(rng, [0, 2]))
            cloud.width, cloud.data = count, array("B", bytes(cloud.data) * count)
        else:
            cases.spoil(cloud, rng)
        try:
            status = status_from_message(cloud)
        except MessageError as error:
            assert str(error).isprintable()
            return error.reason
        self.now += 0.1
        with np.errstate(all="raise", under="ignore"):
            target, why = target_from_status(np.array([8.0, 8.0, 0.0]), status, 0.1, 0.1)
            place = np.array([8.0, 8.0, HEIGHT])
            seen = Inputs(
                self.now, True, True, False, 9.0, 0.1, 0.1, place, np.zeros(3), 0.0, target, why
            )  # fmt: skip
            order = self.landing.step(seen)
        assert order.point is None or np.isfinite(order.point).all()
        return TAKEN

    def close(self, told: Counter[str]) -> None:
        assert told[TAKEN] and told["layout"]


INPUTS: dict[str, Callable[[np.random.Generator, str], Any]] = {
    **dict.fromkeys(("cloud", "pose", "odometry", "gimbal", "transforms", "follow"), Flight),
    **dict.fromkeys(("depth", "camera_info"), Depth),
    **dict.fromkeys(("map", "observed"), Maps),
    **dict.fromkeys(Wishes.MAKE, Wishes),
    "autopilot": Vehicle,
    "parameters": Settings,
    "checkpoint": Checkpoints,
    "land_now": LandNow,
    "status": Told,
}
STRETCH = 200
"""Cases after which everything begins anew."""
LONGEST_S = 600.0
"""For a stretch; a compiled loop that does not end can only be killed."""
MOST_BYTES = 3_000_000_000


@contextmanager
def bounded() -> Iterator[None]:
    """NumPy's warnings are errors, and memory has an end."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def attack(kind: str, seed: int, count: int) -> Counter[str]:
    """So many cases of one input; what became of them, which is all of them.

    Raises:
        AssertionError: one broke something; names the stretch in which it did.
    """
    total: Counter[str] = Counter()
    with bounded():
        for first in range(0, count, STRETCH):
            faulthandler.dump_traceback_later(LONGEST_S, exit=True)
            target = INPUTS[kind](np.random.default_rng([seed, first]), kind)
            told: Counter[str] = Counter()
            try:
                for _ in range(min(STRETCH, count - first)):
                    told[target.send()] += 1
                target.close(told)
            except Exception as error:
                text = f"{kind}, seed {seed}, case {first + told.total()}"
                raise AssertionError(text) from error
            total += told
    assert total.total() == count
    return total
