# SPDX-License-Identifier: Apache-2.0
"""MAVLink over a socket, against a model of ArduPilot and PX4."""

import os
import pty
import socket
import time
import tty
from select import select
from threading import Thread

import numpy as np
import pytest
from autopilot_model import LOITER, PX4_HOLD, Autopilot

from quadtree_lss.onboard.autopilot import link as module
from quadtree_lss.onboard.autopilot.link import ARDUPILOT, GUIDED_MODES, PX4, Link
from quadtree_lss.onboard.config.settings import ConfigError
from quadtree_lss.onboard.core.geometry.rotations import rotation_from_quaternion
from quadtree_lss.onboard.errors import QuadtreeLssError

BOTH = pytest.mark.parametrize("kind", [ARDUPILOT, PX4])
pytestmark = pytest.mark.xdist_group("autopilot")


@pytest.fixture
def fly():
    """Start a model and a link to it, for the duration of the test."""
    ends = []

    def start(kind, place=(3.0, -2.0, 6.0), **how):
        model = Autopilot(kind, place, **how)
        link = Link(model.connection, time.time_ns)
        ends.extend((lambda: model.__exit__(), link.close))
        return model.__enter__(), link

    yield start
    for end in ends:
        end()


def wait(link, condition, seconds=60.0):
    """Poll until the condition is true; return the received poses."""
    navs, end = [], time.monotonic() + seconds
    while not condition(navs):
        assert time.monotonic() < end, "in vain"
        navs += link.poll()
        time.sleep(0.005)
    return navs


@pytest.mark.parametrize(("kind", "body_velocity"), [(ARDUPILOT, False), (PX4, False), (PX4, True)])
def test_poses_match_the_vehicle_by_this_computers_clock(fly, kind, body_velocity):
    model, link = fly(kind)
    with model._lock:
        model.body_velocity = body_velocity
        model.goal = model.position + (8.0, -4.0, 1.0)  # it moves: a wrong stamp is a wrong place
        model.mode = GUIDED_MODES[ARDUPILOT] if kind == ARDUPILOT else PX4_HOLD
    wait(link, lambda navs: len(navs) > 10)
    navs, late = [], []
    while len(navs) < 20:
        navs += wait(link, lambda navs: navs)
        late.append(1e-9 * (time.time_ns() - navs[-1].stamp_ns))
    assert -0.05 < min(late) < 0.25  # not each, on a loaded computer
    nose = rotation_from_quaternion(navs[-1].quaternion)[:, 0]
    np.testing.assert_allclose(nose, [np.sin(0.7), np.cos(0.7), 0.0], atol=1e-5)
    for before, after in zip(navs, navs[1:], strict=False):
        assert after.stamp_ns > before.stamp_ns
    span = 1e-9 * (navs[-1].stamp_ns - navs[0].stamp_ns)
    mean = np.mean([nav.velocity for nav in navs], axis=0)
    np.testing.assert_allclose(navs[-1].position - navs[0].position, span * mean, atol=0.1)
    if kind == ARDUPILOT:
        assert navs[-1].covariance is None
    else:
        variances = navs[-1].covariance.diagonal()[:3]
        np.testing.assert_allclose(variances, [0.02, 0.01, 0.03], rtol=1e-5)


@BOTH
def test_landing_target_frame(fly, kind):
    model, link = fly(kind)
    navs = wait(link, lambda navs: len(navs) > 3)
    link.send_landing_target(np.array([1.0, 2.0, 0.5]), navs[-1])
    wait(link, lambda _: model.targets)
    np.testing.assert_allclose(model.targets[-1][1], [2.0, 1.0, -0.5], atol=1e-5)


def test_status_text_is_complete(fly):
    """Include lines longer than one message with equal beginnings."""
    model, link = fly(ARDUPILOT)
    wait(link, lambda _: link.kind is not None)
    lines = ["x" * 49, *("".join(map(str, range(n)))[:n] for n in (50, 51, 99, 100, 101, 180))]
    for line in lines:
        link.send_text(line, warn=True)
    link.send_text("the last", warn=False)
    wait(link, lambda _: "the last" in model.texts)
    assert model.texts == [*lines, "the last"]


def test_heartbeats_of_other_systems_are_ignored(fly):
    model, link = fly(ARDUPILOT)
    wait(link, lambda _: link.kind is not None)
    model._link.mav.srcSystem, kept = 255, model._link.mav.srcSystem
    model._say("heartbeat", 6, 8, 0, 4, 4)  # a ground station that says "mode 4"
    model._link.mav.srcSystem = kept
    wait(link, lambda navs: len(navs) > 3)
    assert link.mode == LOITER and not link.accepts_set_points


def test_restarted_simulation_time_does_not_block():
    now, said = [1000.0, 1000.0, 1.0, 1.0], []
    link = Link("udpout:127.0.0.1:9", lambda: 0, lambda: now.pop(0))
    link._port.write = said.append
    while now:
        link.poll()
    link.close()
    assert len(said) == 2, "a heartbeat at either time"


@BOTH
def test_source_system_is_not_a_ground_station(fly, kind):
    """ArduPilot's failsafe waits for heartbeats of system 255 after it received one."""
    model, link = fly(kind)
    link.close()
    link = Link(f"udpout:127.0.0.1:{model.port}", time.time_ns)
    said = []
    link._port.write = lambda content: said.append(content[5])  # the sender's system
    link.poll()
    link.close()
    assert said == [1]


def test_invalid_connection_is_a_one_line_error():
    with pytest.raises(ConfigError, match="autopilot.connection = 'tcp:nowhere:1:2'"):
        Link("tcp:nowhere:1:2", time.time_ns)
    with pytest.raises(ConfigError, match="port must be 0-65535"):
        Link("udpin:127.0.0.1:99999", time.time_ns)
    Link(__file__, time.time_ns).poll()  # pymavlink takes it for a recording
    with pytest.raises(QuadtreeLssError, match="'/dev/ttyACM77' cannot be opened") as raised:
        Link("/dev/ttyACM77", time.time_ns)  # it may be plugged in later
    assert not isinstance(raised.value, ConfigError), "the node is to be started again"


def test_takeoff_in_guided_does_not_accept_set_points(fly):
    """The first set-point aborts ArduCopter's takeoff, in its simulator at 0.15 m."""
    model, link = fly(ARDUPILOT)
    model.mode, model.takes_off = GUIDED_MODES[ARDUPILOT], True
    wait(link, lambda _: link.mode == model.mode and link.landed is not None)
    assert not link.accepts_set_points and not link.landed
    model.takes_off = False
    wait(link, lambda _: link.accepts_set_points)


def beat():
    """Return the bytes of a heartbeat: armed, in guided."""
    says = module.dialect().mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    return says.heartbeat_encode(2, ARDUPILOT, 129, 4, 4).pack(says)


def test_serial_device_is_exclusive_and_never_blocks():
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    link = Link(f"{os.ttyname(theirs)},57600", time.time_ns)
    with pytest.raises(QuadtreeLssError, match="cannot be opened"):
        Link(os.ttyname(theirs), time.time_ns)
    # In a thread, for it would wait for ever.
    says = Thread(
        target=lambda: [link.send_set_point(np.zeros(3)) for _ in range(999)], daemon=True
    )
    says.start()
    says.join(10.0)
    assert not says.is_alive()
    os.write(ours, beat())
    wait(link, lambda _: link.kind == ARDUPILOT and link.accepts_set_points and link.armed)
    link.close()
    os.close(ours)
    os.close(theirs)


def test_lost_tcp_peer_does_not_block_and_reconnects():
    door = socket.create_server(("127.0.0.1", 0))
    port = door.getsockname()[1]
    link = Link(f"tcp:127.0.0.1:{port}", time.time_ns)
    door.accept()[0].close()
    door.close()
    begin = time.monotonic()
    for _ in range(10):
        link.poll()
        link.send_set_point(np.zeros(3))
    assert time.monotonic() - begin < 5.0  # pymavlink sleeps for a second in each
    link.close()  # there is nothing to close
    with socket.create_server(("127.0.0.1", port)) as door:
        wait(link, lambda _: select([door], [], [], 0.0)[0])
        with door.accept()[0] as peer:
            peer.sendall(beat())
            wait(link, lambda _: link.kind == ARDUPILOT)
            link.close()
