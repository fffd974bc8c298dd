# SPDX-License-Identifier: Apache-2.0
"""False messages of the autopilot and of other senders must not move the vehicle."""

import numpy as np
import pytest
from autopilot_model import LOITER
from lying_peer import FAST, SCENARIOS, TURNS_M, Others, Ride, attack, beat

from quadtree_lss.onboard.autopilot.link import ARDUPILOT, PX4

pytestmark = pytest.mark.xdist_group("autopilot")


OF_PX4 = [(name, PX4) for name in SCENARIOS if "contact" in name]


@pytest.mark.quick("height_reset-3")
@pytest.mark.parametrize(("scenario", "kind"), [*((s, ARDUPILOT) for s in SCENARIOS), *OF_PX4])
def test_false_message_does_not_move_the_vehicle(scenario, kind):
    # PX4 leaves offboard after half a second of its time without a set-point.
    pace = 2.0 if kind == PX4 else 3.0
    with Ride(kind=kind, pace=pace, may_command="arming") as ride:
        SCENARIOS[scenario](ride)
        height = ride.model.lowest = ride.height
        place = ride.model.enu
        ride.on(9.0)
        told = f"{ride.states} {ride.model.texts}"
        assert ride.model.lowest > max(height - TURNS_M, 0.05), told
        assert ride.height < height + FAST["gate_height"] + 1.0, told
        assert np.hypot(*(ride.model.enu - place)[:2]) < 3.0, told
        assert not ride.model.commands, "nothing but set-points"
        assert ride.state in ("give_up", "hold", "pilot"), told
        if "reset" in scenario or "drops" in scenario:
            assert ride.state == "give_up", told


@pytest.mark.slow
def test_other_senders_are_ignored():
    """A second vehicle with the same system id says that it is disarmed and in another mode; many
    say one byte."""
    with Ride(pace=1.0) as ride:
        ride.handed_over().within("transit")
        twin = [beat(mode=LOITER, base=1), b"\xfd"]
        with Others(ride, twin, 1000, senders=200) as others:
            ride.within("touchdown")
        assert "pilot" not in ride.states[1:]
        assert others.sent > 1000 and not others.heard


@pytest.mark.slow
@pytest.mark.parametrize(
    "pieces",
    [[beat(system=9)], [beat() * 2000], [b"\xfd\xff" * 30000]],
    ids=["few", "many", "noise"],
)
def test_set_point_rate_under_foreign_messages(pieces):
    with Ride(pace=1.0) as ride:
        ride.handed_over().within("transit", "descend").target = None
        ride.within("hold", "wave_off").on(1.0)
        points = len(ride.model.points)
        with Others(ride, pieces, 5000 if len(pieces[0]) < 99 else 50, senders=9):
            ride.on(4.0)
        assert len(ride.model.points) - points > 0.9 * 40


@pytest.mark.slow
def test_no_set_point_after_the_heartbeat_of_a_mode_change():
    with Ride() as ride:
        ride.below(4.0).model.switch(LOITER)
        switched = ride.model._now
        ride.on(3.0)
        late = [at - switched for at, _ in ride.model.points if at > switched]
        assert ride.state == "pilot" and (not late or max(late) < 0.5), late


@pytest.mark.slow
def test_pose_without_velocity_is_rejected():
    with Ride() as ride:
        ride.handed_over().within("transit").model.knows_velocity = False
        ride.within("hold")
        assert ride.controller.link.rejected["velocity"] > 0


@pytest.mark.slow
def test_landed_state_expires():
    with Ride() as ride:
        ride.until(lambda: ride.controller.link.landed is False).model.claims = 1
        ride.until(lambda: ride.controller.link.landed).model.claims = 0  # it does not know
        ride.handed_over().on(1.0)
        assert ride.state == "pilot"
        ride.until(lambda: ride.controller.link.landed is None).on(1.0)
        assert ride.state == "pilot" and ride.controller.link.landed is None
        ride.model.claims = None
        ride.within("transit")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_hostile_messages_do_not_lower_a_vehicle_without_a_target(seed):
    sank, told = attack(seed, 2000)
    assert sank < TURNS_M, told
