# SPDX-License-Identifier: Apache-2.0
"""Where the package is installed: by colcon in a workspace that is sourced, else by pip."""

import os
import sys
from pathlib import Path

_SOURCED = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
PREFIX = next((p for p in _SOURCED if (p / "share" / "quadtree_lss").is_dir()), Path(sys.prefix))
SHARE = PREFIX / "share" / "quadtree_lss"
