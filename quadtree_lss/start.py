# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""Entry points of the command line, which end on Ctrl-C also during the slow imports.

Before this module runs, Ctrl-C meets the start of Python itself, which prints a traceback. So it
imports only what the start has loaded.
"""

from __future__ import annotations

import os
import signal
import sys


def main(argv: list[str] | None = None) -> int:
    """Run one command of ``quadtree-lss`` and return its exit code."""
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:  # not ignored, as in a job in the background
        signal.signal(signal.SIGINT, _exit_at_once)
    from quadtree_lss import cli  # takes a second

    if interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return cli.main(argv)


def _exit_at_once(*_: object) -> None:
    """End the process; KeyboardInterrupt would be lost in some of the imports."""
    os.write(2, b"quadtree-lss: interrupted\n")
    os._exit(130)


def main_of_ros() -> int:
    """Run ``replay_bag``, ``simulate`` or ``evaluate`` of ``ros2 run``, by the executable name."""
    name = os.path.basename(sys.argv[0]).removesuffix("_bag")
    return main([name, *sys.argv[1:]])
