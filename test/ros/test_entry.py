# SPDX-License-Identifier: Apache-2.0
"""Start and exit of nodes with signals at any time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from quadtree_lss.onboard.nodes import entry

pytestmark = pytest.mark.xdist_group("ros")


def hears(pid: int, number: int) -> bool:
    """Return whether a process runs and has a handler of a signal."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return False
    caught = next((line.split()[1] for line in lines if line.startswith("SigCgt:")), "0")
    return bool(int(caught, 16) >> (number - 1) & 1)


@pytest.mark.parametrize(
    ("name", "number"),
    list(zip(("mapping_node", "lss_node", "autopilot_node"), entry.SIGNALS, strict=True)),
)
def test_signal_during_the_start_is_a_clean_exit(ros, name, number):
    node = ros.start(name)
    while not hears(node.process.pid, signal.SIGHUP):  # the last that it comes to hear
        node.check()
    assert node.stop(number) == 0
    lines = [line for line in node.output().splitlines() if "starting, waiting" not in line]
    assert len(lines) <= 1 and all("[INFO]" in line for line in lines), "none, or that it started"


def test_signal_handlers_precede_slow_imports():
    program = (
        "import sys; before = set(sys.modules)\n"
        "import quadtree_lss.onboard.nodes.entry\n"
        "print(*sorted(name for name in sys.modules if name not in before))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert "quadtree_lss" in loaded and not loaded & {"numpy", "scipy", "rclpy", "yaml"}


def test_ignored_sighup_stays_ignored():
    program = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from quadtree_lss.onboard.nodes.entry import stop_on_signal\n"
        "stop = stop_on_signal()\n"
        "signal.raise_signal(signal.SIGHUP); assert not stop.requested\n"
        "signal.raise_signal(signal.SIGTERM); assert stop.requested\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_second_signal_interrupts_a_callback(monkeypatch):
    before = {number: signal.getsignal(number) for number in entry.SIGNALS}
    try:
        stop = entry.StopOnSignal()
        with stop.interrupting():
            for _ in range(2):  # a terminal and launch both send the first
                os.kill(os.getpid(), signal.SIGINT)
            assert stop.requested
            monkeypatch.setattr(entry, "INTERRUPT_AFTER_S", 0.0)
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)  # what ends a node is not broken off
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
