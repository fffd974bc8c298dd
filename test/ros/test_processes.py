# SPDX-License-Identifier: Apache-2.0
"""Different ROS domains for processes that start at the same time."""

import subprocess
import sys
from contextlib import ExitStack

import pytest

from quadtree_lss.lab.live import processes
from quadtree_lss.lab.live.processes import ProcessError, local_domain

pytestmark = pytest.mark.xdist_group("ros")

SPARE = range(98, 100)
"""Domains that are not assigned otherwise; above 100 the system assigns their ports."""

HOLD = f"""\
import sys
from pathlib import Path
from quadtree_lss.lab.live import processes
processes.DOMAINS = {SPARE}
with processes.local_domain(Path(sys.argv[1])) as domain:
    print(domain, flush=True)
    sys.stdin.read()
"""


def test_concurrent_processes_get_different_domains(tmp_path, monkeypatch):
    """Start as many processes as there are domains, before any has a participant."""
    monkeypatch.setattr(processes, "DOMAINS", SPARE)
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with ExitStack() as stack:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        others = [stack.enter_context(subprocess.Popen(command, **pipes)) for _ in SPARE]
        numbers = [int(other.stdout.readline()) for other in others]
        assert sorted(numbers) == list(SPARE)
        with pytest.raises(ProcessError, match="between 98 and 99"), local_domain(tmp_path):
            pass
        assert others[0].communicate()[0] == b"" and others[0].returncode == 0
        with local_domain(tmp_path) as domain:
            assert domain == numbers[0]
        for other in others[1:]:
            other.communicate()
