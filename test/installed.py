# SPDX-License-Identifier: Apache-2.0
"""Where the package is installed: by colcon in a workspace that is sourced, else by pip."""

import os
import subprocess
import sys
from pathlib import Path

_SOURCED = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
PREFIX = next((p for p in _SOURCED if (p / "share" / "quadtree_lss").is_dir()), Path(sys.prefix))
SHARE = PREFIX / "share" / "quadtree_lss"


def error_without(module, *arguments, cwd):
    """The one line with which the command ends where a module is not installed."""
    program = f"import sys; sys.modules[{module!r}] = None; from quadtree_lss.cli import main; "
    program += f"sys.exit(main({[str(argument) for argument in arguments]}))"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    return done.stderr
