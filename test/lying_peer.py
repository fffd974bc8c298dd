# SPDX-License-Identifier: Apache-2.0
"""An autopilot that lies, over MAVLink and loopback, and the landing it is to be shown: scenarios
by name. Time runs faster than real; what counts is where the vehicle truly is."""

import math
import socket
import threading
import time
from contextlib import suppress

import numpy as np
from autopilot_model import LOITER, Autopilot
from fuzz.cases import damaged, random_of_autopilot

from quadtree_lss.onboard.autopilot.controller import Controller
from quadtree_lss.onboard.autopilot.inputs import Target
from quadtree_lss.onboard.autopilot.link import ARDUPILOT, GUIDED_MODES, dialect
from quadtree_lss.onboard.config.sections import AutopilotConfig

TURNS_M = 1.2
"""Height that the vehicle loses before it climbs, by its speed at the false message."""
FAST = {"gate_height": 5.0, "descent_speed": 1.5, "touchdown_speed": 0.5, "transit_speed": 4.0}


class Ride:
    """A vehicle in the air with the landing in charge; ``target`` None is a target withdrawn.

    A test calls `until` and `on`, and changes the model, the target or the configuration between.
    """

    def __init__(self, place=(3.0, -2.0, 7.0), kind=ARDUPILOT, pace=3.0, **parameters):
        self.model = Autopilot(kind, place, pace=pace).__enter__()
        config = AutopilotConfig(**{**FAST, **parameters, "connection": self.model.connection})
        self._pace, self._began, self._zero = pace, time.time(), time.monotonic()
        self._next = 0.0
        self.target, self.offset, self.order = np.zeros(3), math.nan, None
        self.states, self.orders = [], 0
        self.controller = Controller(config, self._clock, self.now)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.controller.link.close()
        self.model.__exit__()

    def now(self):
        return self._pace * (time.monotonic() - self._zero)

    def _clock(self):
        return round(1e9 * (self._began + self.now()))

    @property
    def height(self):
        return -self.model.position[2]

    @property
    def state(self):
        return self.states[-1] if self.states else None

    def step(self):
        self.controller.poll()
        if self.now() >= self._next:
            self._next = max(self._next + 0.1, self.now() - 0.1)
            target = self.target
            if target is not None:
                target = Target(
                    target + (0.0, 0.0, np.nan_to_num(self.offset)), 0.1, 0.2, self.offset
                )
            self.order = self.controller.step(target, "withdrawn")
            self.orders += self.order is not None
            if self.order is not None and self.state != self.order.state:
                self.states.append(self.order.state)
        time.sleep(0.001)

    def timed(self):
        """Return the duration of a step, s."""
        began = time.monotonic()
        self.step()
        return time.monotonic() - began

    def until(self, condition, seconds=180.0):
        end = self.now() + seconds
        while not condition():
            assert self.now() < end, (self.states, self.model.enu, self.order, self.model.texts)
            self.step()
        return self

    def on(self, seconds):
        end = self.now() + seconds
        while self.now() < end:
            self.step()
        return self

    def handed_over(self):
        follows = GUIDED_MODES[self.model.kind]
        return self.until(
            lambda: self.order and (self.model.mode == follows or self.model.switch(follows))
        )

    def within(self, *states):
        return self.until(lambda: self.state in states)

    def below(self, height):
        return self.handed_over().until(lambda: self.height < height)


class Others(threading.Thread):
    """Others on the same port: ``rate`` pieces of bytes in a second, by turns; what they hear."""

    def __init__(self, ride, pieces, rate, senders=1):
        super().__init__(daemon=True)
        at = ("127.0.0.1", ride.model.port)
        self._pieces, self._rate, self._end = pieces, rate, threading.Event()
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(senders)]
        for one in self._sockets:
            one.connect(at)
            one.setblocking(False)
        self.sent = 0

    def run(self):
        began, number = time.monotonic(), len(self._sockets)
        while not self._end.is_set():
            while self.sent < self._rate * (time.monotonic() - began):
                with suppress(OSError):
                    self._sockets[self.sent % number].send(
                        self._pieces[self.sent % len(self._pieces)]
                    )
                self.sent += 1
            time.sleep(0.002)

    def send(self, content):
        self._sockets[0].send(content)

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        self.join(5.0)

    @property
    def heard(self):
        """Return the number of bytes they received."""
        number = 0
        for one in self._sockets:
            with suppress(OSError):
                number += len(one.recv(999))
        return number


def beat(system=7, autopilot=ARDUPILOT, mode=4, base=129):
    """Return the bytes of a heartbeat: armed, in guided."""
    says = dialect().mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    return says.heartbeat_encode(2, autopilot, base, mode, 4).pack(says)


def one_contact_in_a_climb(ride):
    ride.below(3.7).target = None
    ride.within("wave_off").model._say("extended_sys_state", 0, 1)


def contact_for_good_in_a_climb(ride):
    ride.below(2.0).model.claims, ride.target = 1, None


def contact_that_ends_again(ride):
    ride.below(0.4).model.claims = 1
    ride.within("touchdown").target = None
    ride.model.claims = 2


def _reset_in_a_gap(ride, shift, height=3.4):
    ride.below(height).model.frozen = True
    ride.on(1.6)
    ride.model.shift[:] = shift
    ride.model.frozen = False


def height_reset_in_a_gap(ride):
    _reset_in_a_gap(ride, (0.0, 0.0, -6.5))


def height_reset(ride):
    ride.below(4.9).model.shift[:] = 0.0, 0.0, 30.0


def target_that_drops(ride):
    ride.below(4.0).target = np.array([0.0, 0.0, -3.0])


def offset_that_drops(ride):
    ride.offset = 0.0
    ride.below(4.0).offset = -30.0


def offset_that_drops_in_transit(ride):
    ride.offset = 0.0
    ride.handed_over().within("transit")
    ride.step()
    ride.offset, ride.target = -40.0, np.array([6.0, 0.0, 0.0])


def offset_that_creeps_down(ride):
    ride.offset = 0.0
    ride.below(4.9)
    for _ in range(20):
        ride.offset -= 0.4
        ride.on(0.4)


def deep_gate(ride):
    """Set live on the way down, so that a quarter of it lies over the vehicle."""
    ride.below(4.0)
    config = ride.controller.config
    ride.controller.configure(type(config)(**{**vars(config), "gate_height": 60.0}))
    ride.step()
    assert ride.state == "descend"
    ride.target = None


def pilot_takes_over(ride):
    ride.below(3.0).model.switch(LOITER)


SCENARIOS = {
    scenario.__name__: scenario
    for scenario in (
        one_contact_in_a_climb, contact_for_good_in_a_climb,
        contact_that_ends_again, height_reset_in_a_gap,
        height_reset, target_that_drops,
        offset_that_drops, offset_that_drops_in_transit,
        offset_that_creeps_down, deep_gate, pilot_takes_over,
    )
}  # fmt: skip
"""Each brings a ride to its lie; from then on the vehicle must not come down, nor climb away."""


def hostile(rng, mavlink, now_ns):
    """Bytes of one message, of anything, from the vehicle's system or another."""
    says = mavlink.MAVLink(None, srcSystem=int(rng.choice([7, 7, 7, 1, 255])), srcComponent=1)
    content = random_of_autopilot(rng, mavlink, now_ns)
    if rng.random() < 0.2:
        content = mavlink.MAVLink_extended_sys_state_message(0, int(rng.integers(0, 5)))
    content = content.pack(says)
    return damaged(content, rng) if rng.random() < 0.1 else content


def attack(seed, count):
    """One ride amid ``count`` hostile messages, half of them from the autopilot's own address: by
    how much the vehicle sank, m, after its target was withdrawn, and a line that tells of it."""
    rng, mavlink = np.random.default_rng(seed), dialect().mavlink
    with Ride(place=(1.0, -1.0, 6.0), may_command="arming") as ride:
        begins = rng.uniform(0.8, 6.0)
        with suppress(AssertionError):  # on a computer that is too busy it holds on the way
            ride.below(begins)
        ride.target = None
        height = ride.model.lowest = ride.height
        with Others(ride, [b""], 0) as others:
            for number in range(count):
                content = hostile(rng, mavlink, round(1e9 * ride.model._clock()))
                with suppress(OSError):
                    if number % 2:
                        ride.model._link.write(content)
                    else:
                        others.send(content)
                if number % 20 == 0:
                    ride.step()
        ride.on(4.0)
        sank = height - ride.model.lowest
        told = f"seed {seed}: from {height:.1f} m, lowest {ride.model.lowest:.1f}, {ride.states}"
        assert ride.order is not None and not ride.model.commands, told
        return sank, told
