# SPDX-License-Identifier: Apache-2.0
"""For all tests: one thread each for numerical libraries, since tests run side by side."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
