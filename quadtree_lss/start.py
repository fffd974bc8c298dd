# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""Entry points of the command line, which handle Ctrl-C during the slow imports."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command of ``quadtree-lss`` and return its exit code."""
    try:
        from quadtree_lss import cli  # takes a second

        return cli.main(argv)
    except KeyboardInterrupt:
        print("quadtree-lss: interrupted", file=sys.stderr)
        return 130


def main_of_ros() -> int:
    """Run ``replay_bag``, ``simulate`` or ``evaluate`` of ``ros2 run``, by the executable name."""
    return main([Path(sys.argv[0]).stem.removesuffix("_bag"), *sys.argv[1:]])
