# SPDX-License-Identifier: Apache-2.0
"""Landings with PX4, software in the loop with its simulator SIH, as with ArduCopter.

``PX4`` names the folder of a build of ``px4_sitl``; without it nothing is flown. With the simulated
GPS and compass the estimate of PX4 is wrong by decimetres and ten degrees, so this program sends it
position and heading with errors of ``FIX_M`` and ``FIX_RAD``. The pilot takes off, holds and
switches to offboard.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import BinaryIO

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from arducopter import CONFIG, FAULTS, HEIGHT_M, Copter, bound, main
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.autopilot.frames import R_ENU_NED
from quadtree_lss.onboard.autopilot.link import (
    ARM_DISARM,
    CUSTOM_MODE,
    DO_SET_MODE,
    GUIDED_MODES,
    PX4,
    SET_INTERVAL,
    dialect,
)
from quadtree_lss.onboard.core.geometry.rotations import rotation_from_quaternion

HOME, METRES_PER_DEG = (47.397742, 8.545594, 489.4), 111_194.9
TAKE_OFF, HOLD = 4 << 16 | 2 << 24, 4 << 16 | 3 << 24
TRUTH, TURN, TRUTH_HZ = 115, 31, 100.0
FIX_HZ, FIX_M, FIX_RAD = 30.0, 0.02, 0.01
SIMULATOR_PARAMETERS = {
    "MIS_TAKEOFF_ALT": HEIGHT_M, "COM_RC_IN_MODE": 1, "SDLOG_BACKEND": 0,
    "EKF2_EV_CTRL": 11, "EKF2_GPS_CTRL": 0, "EKF2_HGT_REF": 3, "EKF2_MAG_TYPE": 5,
    "EKF2_ACC_NOISE": 1.0, "EKF2_GYR_NOISE": 0.1,
    "EKF2_EVP_NOISE": FIX_M, "EKF2_EVA_NOISE": 0.05, "SENS_EN_GPSSIM": 0, "SYS_HAS_GPS": 0,
    "SYS_HAS_MAG": 0,
}  # fmt: skip
"""A joystick at the ground station; external position and heading."""
UNSUPPORTED_FAULTS = ("wind of 8 m/s", "GPS 11 m off for 4 s")
"""Faults that SIH does not simulate."""


class Px4(Copter):
    """PX4 with SIH in place of ArduCopter."""

    NAME = "PX4"
    GUIDED_MODE = GUIDED_MODES[PX4]

    def _launch(
        self, binary: str, folder: Path, heading: float, output: BinaryIO
    ) -> subprocess.Popen[bytes]:
        mavutil = dialect()
        for instance in map(
            int, np.random.default_rng().permutation(10)
        ):  # further instances would share a port
            try:
                with bound(14540 + instance), bound(19410 + instance):
                    break
            except OSError:
                continue
        self._own = mavutil.mavlink_connection(f"udpin:127.0.0.1:{14540 + instance}")
        self._truth = mavutil.mavlink_connection(f"udpin:127.0.0.1:{19410 + instance}")
        ground = f"udpout:127.0.0.1:{18570 + instance}"
        self._ground = mavutil.mavlink_connection(ground, source_system=255)
        lines = (CONFIG / "px4.params").read_text("utf-8").splitlines()
        given = [line.split() for line in lines if not line.startswith("#")]
        values = {name: value for _, _, name, value, _ in given if name[:4] not in ("MAV_", "SER_")}
        values |= {name: str(value) for name, value in SIMULATOR_PARAMETERS.items()}
        env = {**os.environ, "PX4_SIM_MODEL": "sihsim_quadx"}
        env |= {f"PX4_PARAM_{name}": value for name, value in values.items()}
        self._system, self._attitude = instance + 1, np.full(4, np.nan)
        self._next_heartbeat = self._last_fix = 0.0
        self._noise = np.random.default_rng(instance)
        build = Path(binary).resolve()
        return subprocess.Popen(
            [build / "bin" / "px4", "-d", "-i", str(instance), build / "etc"],
            cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, env=env,
        )  # fmt: skip

    def truth(self) -> tuple[float, np.ndarray, np.ndarray]:
        """As in `Copter`, relative to the start."""
        at, (latitude, longitude, height, *_) = self._true_state
        turn = R_ENU_NED @ rotation_from_quaternion(np.roll(self._attitude, -1))
        return at, self._metres(latitude, longitude, height), turn

    def _metres(self, latitude: float, longitude: float, height: float) -> np.ndarray:
        north = METRES_PER_DEG * (latitude - HOME[0])
        east = METRES_PER_DEG * math.cos(math.radians(HOME[0])) * (longitude - HOME[1])
        return np.array([east, north, height - HOME[2]])

    def start(self) -> None:
        """Switch to take-off and arm."""
        self._switch(TAKE_OFF)
        self.command(ARM_DISARM, 1.0)

    def take_off(self) -> None:
        """Do nothing; the take-off mode climbs and holds."""

    def hover(self) -> None:
        """Do nothing; the take-off mode climbs and holds."""

    def switch_to_pilot(self) -> None:
        """Switch to hold."""
        self._switch(HOLD)

    def pace(self, seconds: float) -> None:
        """Do nothing; PX4 uses ``PX4_SIM_SPEED_FACTOR``."""

    def _switch(self, mode: int) -> None:
        self.command(DO_SET_MODE, CUSTOM_MODE, mode >> 16 & 0xFF, mode >> 24)

    def _receive_truth(self) -> None:
        while (message := self._truth.recv_msg()) is not None:
            kind = message.get_type()
            if kind == "ATTITUDE_QUATERNION":
                self.now = max(self.now, 1e-3 * message.time_boot_ms)
            elif kind == "HIL_STATE_QUATERNION":
                self._attitude = np.array(message.attitude_quaternion)
                place = 1e-7 * message.lat, 1e-7 * message.lon, 1e-3 * message.alt
                self._true_state = (self.now, place)
                if self.now - self._last_fix >= 1.0 / FIX_HZ:
                    self._last_fix = self.now
                    self._send_position()

    def _send_position(self) -> None:
        """Send position and attitude as an external vision system would."""
        _, place, turn = self.truth()
        north_east_down = R_ENU_NED @ place + FIX_M * self._noise.standard_normal(3)
        angles = Rotation.from_matrix(R_ENU_NED @ turn).as_euler("ZYX")[::-1]
        covariance = np.zeros((6, 6))
        covariance[np.diag_indices(6)] = np.repeat((FIX_M**2, FIX_RAD**2), 3)
        sent = *north_east_down, *(angles + FIX_RAD * self._noise.standard_normal(3))
        upper = covariance[np.triu_indices(6)]
        self._truth.mav.vision_position_estimate_send(round(1e6 * self.now), *sent, upper)

    def _send_sticks(self) -> None:
        self._ground.mav.manual_control_send(self._system, 0, 0, 500, 0, 0)
        if time.monotonic() > self._next_heartbeat:
            self._next_heartbeat = time.monotonic() + 1.0
            self._ground.mav.heartbeat_send(6, 8, 0, 0, 0)
            begin = round(1e7 * HOME[0]), round(1e7 * HOME[1]), 0
            self._ground.mav.set_gps_global_origin_send(self._system, *begin)
            for number in (TRUTH, TURN):
                values = (number, 1e6 / TRUTH_HZ, *[0.0] * 5)
                self._truth.mav.command_long_send(self._system, 1, SET_INTERVAL, 0, *values)


if __name__ == "__main__":
    sys.exit(main(None, Px4, "PX4", [name for name in FAULTS if name not in UNSUPPORTED_FAULTS]))
