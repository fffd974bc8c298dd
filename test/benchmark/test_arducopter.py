# SPDX-License-Identifier: Apache-2.0
"""What judges the flights with ArduCopter: true place, bridge and ground; without the binary."""

import dataclasses
import json
import struct
import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))

import arducopter

from quadtree_lss.lab.simulation.safety import worst_contact
from quadtree_lss.lab.simulation.scenarios import SCENARIOS
from quadtree_lss.onboard.autopilot.link import dialect


@pytest.fixture
def copter(tmp_path):
    told: list[float] = []
    with arducopter.Copter("true", tmp_path, 0.0, told.append) as copter:
        yield copter


def wait(condition):
    end = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_true_place_is_east_north_up_of_home(copter):
    """11.132 m north by a ten-thousandth of a degree; the nose to the east, the left wing up."""
    latitude, longitude, height = arducopter.HOME
    place = np.radians([longitude, latitude + 1e-4]), height + 7.0
    turn = np.radians([20.0, 0.0, 90.0])
    packet = struct.pack(">II3d4f", 24, 0, *place[0], place[1], place[1], *turn)
    copter._truth.getsockname()
    sender = arducopter.socket.socket(arducopter.socket.AF_INET, arducopter.socket.SOCK_DGRAM)
    sender.sendto(packet, copter._truth.getsockname())
    sender.close()
    wait(lambda: copter.truth()[0] > 0)
    _, found, axes = copter.truth()
    np.testing.assert_allclose(found, [0.0, 11.132, 7.0], atol=1e-3)
    np.testing.assert_allclose(axes[:, 0], [1.0, 0.0, 0.0], atol=1e-6)
    c, s = np.cos(turn[0]), np.sin(turn[0])
    np.testing.assert_allclose(axes[:, 2], [0.0, s, -c], atol=1e-6)


def test_the_bridge_passes_loses_delays_and_cuts(copter):
    mavutil = dialect()
    sitl = mavutil.mavlink_connection(f"udpout:127.0.0.1:{copter._own.port.getsockname()[1]}")
    node = mavutil.mavlink_connection(f"udpin:127.0.0.1:{copter.port}")

    boot_ms = 1000

    def heard(after_ms):
        nonlocal boot_ms
        boot_ms += after_ms
        sitl.mav.local_position_ned_send(boot_ms, *[0.0] * 6)
        found = set()
        for _ in range(2):  # once the second comes, what was sent before the first has or will not
            sitl.mav.heartbeat_send(2, 3, 0, 4, 4)
            end, kind = time.monotonic() + (0.3 if copter.cut else 60.0), None
            while kind != "HEARTBEAT" and time.monotonic() < end:
                message = node.recv_msg()
                kind = message and message.get_type()
                found |= {kind} - {None}
        return found

    both = {"HEARTBEAT", "LOCAL_POSITION_NED"}
    assert heard(0) == both and copter.now >= 1.0
    copter.lost = True
    assert heard(100) == {"HEARTBEAT"}
    copter.lost, copter.delay = False, 0.6
    assert heard(100) == {"HEARTBEAT"} and heard(700) == both, "the one before"
    copter.delay = 0.0
    assert heard(700) == both
    copter.cut = True
    assert heard(100) == set()
    sitl.close()
    node.close()


def test_a_touchdown_is_judged_by_the_true_ground_and_by_what_was_forbidden(tmp_path):
    flight = arducopter.Flight("", 5, "", tmp_path)
    terrain, gear = flight.terrain, SCENARIOS["drone"].lander
    places = np.random.default_rng(6).uniform(-10.0, 10.0, (200, 2))
    slope, rise = worst_contact(terrain, places, gear)
    good = np.flatnonzero((slope < 0.05) & (rise < 0.03))[0]
    bad = np.flatnonzero(rise > 0.15)[0]
    for row, ground in ((good, "safe"), (bad, "unsafe")):
        flight._target = np.append(places[row] + (0.3, 0.4), 0.0)
        flight._judge(np.append(places[row], 0.0))
        assert flight.landing.ground == ground
        assert flight.landing.miss == pytest.approx(0.5)
    square = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    for beside, ground in ((1.9, "withdrawn"), (2.1, "safe")):
        flight._keep_out = places[good] + square + (beside, 0.0)
        flight._judge(np.append(places[good], 0.0))
        assert flight.landing.ground == ground


def test_recorded_flights_are_not_flown_again(tmp_path, monkeypatch, capsys):
    """Nor do flights of other seeds and faults count."""
    monkeypatch.setenv("ARDUCOPTER", str(tmp_path / "none"))
    records, args = tmp_path / "flights", ["--landings", "1", "--faults", "1", "--seed", "5"]
    fault = arducopter.FAULTS[0]
    flown = [
        arducopter.Landing(5, "", "landed", "safe", 0.25),
        arducopter.Landing(6, fault, "hovered"),
        arducopter.Landing(7, "", "flew away"),
        arducopter.Landing(6, "", "landed", "unsafe", 0.5),
    ]
    lines = [json.dumps(dataclasses.asdict(one)) for one in flown]
    records.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    assert arducopter.main([*args, "--records", str(records)]) == 0
    said = capsys.readouterr().out
    assert "2 flights, seeds from 5" in said and "0.25" in said and "0.50" not in said
    assert len(records.read_text("utf-8").splitlines()) == 4
