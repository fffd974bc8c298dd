# SPDX-License-Identifier: Apache-2.0
"""For all tests: one thread each for numerical libraries, since tests run side by side; signals as
in a terminal, for whatever started the tests may ignore some (``nohup``, a job in the background)
and programs inherit that."""

import os
import signal

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

for _number, _usual in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGTERM, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)
