# SPDX-License-Identifier: Apache-2.0
"""For all tests. The package that is installed is tested, not the checkout, in which colcon starts
them, unless PYTHONPATH names it. One thread each for numerical libraries, since tests run side by
side. Hypothesis draws the same examples in every run, and others with
``--hypothesis-profile default``. Signals as in a terminal, for whatever started the tests may
ignore some (``nohup``, a job in the background) and programs inherit that."""

import os
import signal
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

_ROOT = Path(__file__).resolve().parents[1]
if str(_ROOT) not in os.environ.get("PYTHONPATH", "").split(os.pathsep):
    sys.path[:] = [folder for folder in sys.path if Path(folder or ".").resolve() != _ROOT]

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Modules that are not collected without a package; one that skips itself ends `colcon test`.
_NEEDS = {
    "pymavlink": ["autopilot/test_link.py", "autopilot/test_lies.py", "ros/test_autopilot.py"],
    "rclpy": ["ros/test_flight.py"],
    "distributed": ["campaign/test_engine.py"],
}
collect_ignore = [path for name, of in _NEEDS.items() if not find_spec(name) for path in of]

_SLOW = [HealthCheck.too_slow]
settings.register_profile(
    "same", derandomize=True, database=None, deadline=None, suppress_health_check=_SLOW
)
settings.load_profile("same")

for _number, _usual in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGTERM, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)


def pytest_make_parametrize_id(val):
    """Name parameters that are long texts by their beginning."""
    return ascii(val[:40]) if isinstance(val, str | bytes) and len(val) > 100 else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark parameters that are not `quick` as slow, and put the largest groups first: most of their
    tests wait for processes while the others compute."""
    groups = {}
    for item in items:
        quick = item.get_closest_marker("quick")
        if quick and item.callspec.id not in quick.args:
            item.add_marker(pytest.mark.slow)
        if "_browser" in item.fixturenames or "report" in item.path.parts:  # one for all
            item.add_marker(pytest.mark.xdist_group("browser"))
        mark = item.get_closest_marker("xdist_group")
        groups.setdefault(mark and mark.args[0], []).append(item)
    alone, items[:] = groups.pop(None, []), []
    step = 2 * len(alone) // (3 * len(groups) + 1)
    for group in sorted(groups.values(), key=len, reverse=True):
        items += [*group, *alone[:step]]
        del alone[:step]
    items += alone


def pytest_terminal_summary(terminalreporter):
    """Say how many tests ran, at any verbosity: a run of none is easily overlooked."""
    counts = {outcome: len(reports) for outcome, reports in terminalreporter.stats.items()}
    ran = sum(counts.get(outcome, 0) for outcome in ("passed", "failed", "xfailed", "xpassed"))
    terminalreporter.write_line(f"{ran} tests ran, {counts.get('skipped', 0)} were skipped")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session, exitstatus):
    """End a run of no test with an error: colcon takes pytest's own exit code for a success."""
    if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session")
def _browser(tmp_path_factory):
    from report.pages import Browser

    browser = Browser(tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


@pytest.fixture
def in_browser(_browser, tmp_path):
    """Of a page and some steps on it, what a browser tells: see `report.pages.in_browser`."""
    from report.pages import in_browser

    return partial(in_browser, _browser, tmp_path)
