# SPDX-License-Identifier: Apache-2.0
"""The same flight over DDS with the real nodes and in lock-step: only timing differs."""

from contextlib import ExitStack

import numpy as np
import psutil
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.node import Node

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.lab.flight.flight import TICK, Flight
from quadtree_lss.lab.flight.flight_page import write_flight
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.lab.live.flight import fly_live
from quadtree_lss.lab.live.processes import ProcessError

SHORT = {"slant_range": 260.0, "speed": 26.0, "half": 8.0, "scatter": 3.0, "plan": {"survey": 3.0}}
SEED = 40049
DOMAIN = 100  # none that is taken at random
pytestmark = [pytest.mark.xdist_group("ros_flight"), pytest.mark.slow]  # one flight for all


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    return fly_live(SEED, flight_settings(SHORT), tmp_path_factory.mktemp("live"))


def test_it_lands_safely_by_what_the_nodes_say(live):
    figures = live.figures
    assert figures["outcome"] == "touchdown" and figures["safe"], figures
    assert figures["map_said"] in ("safe", "partly_unobserved") and live.last is not None
    assert figures["restarts"] == 0 and figures["others"] == []
    assert any(said is not None for _, said in live.heard)
    assert any(d.what == "target" for d in live.flight.pilot.decisions)


def test_its_page_shows_the_sites_and_targets_that_the_nodes_published(live, tmp_path):
    published = live.told["published_sites"]
    np.testing.assert_allclose(live.last.sites.position, published, atol=1e-6)
    write_flight(tmp_path, live)
    content = load_results(tmp_path)
    np.testing.assert_allclose(content.positions, published, atol=1e-6)
    heard = [said for _, said in live.heard if said is not None]
    assert len(content.selected["id"]) == len(live.targets) > 0
    last = content.selected["x"][-1], content.selected["y"][-1]
    np.testing.assert_allclose(last, heard[-1][:2], atol=1e-4)


def test_with_the_same_answers_at_the_same_time_it_is_the_same_flight(live):
    """To the bit: nothing else came from the transport."""
    again, answers = Flight(SEED, flight_settings(SHORT)), list(live.heard)
    while not again.outcome:
        again.step()
        while answers and answers[0][0] <= round(again.time / TICK):
            again.pilot.hear(answers.pop(0)[1])
    assert again.samples == live.flight.samples
    assert again.pilot.decisions == live.flight.pilot.decisions


def test_nodes_that_are_killed_from_outside_and_strangers(tmp_path):
    """Nodes are started again, the outcome is there, and it says that others spoke."""
    settings, killed, kept = flight_settings(SHORT), set(), []
    with ExitStack() as stack:

        def meddle(seconds):
            if seconds > 3.0 and not killed:
                for child in psutil.Process().children():
                    if "_node" in " ".join(child.cmdline()):
                        killed.add(child.pid)
                        child.kill()
                rclpy.init(context=(context := Context()), domain_id=DOMAIN)
                stack.callback(context.try_shutdown)
                other = Node("foreign", context=context)
                other.create_publisher(PoseWithCovarianceStamped, "nav/pose", 10)
                kept.append(other)

        figures = fly_live(SEED, settings, tmp_path, progress=meddle, domain=DOMAIN).figures
        assert len(killed) == 2 and figures["restarts"] == 2 and figures["time"] > 10.0
        assert figures["outcome"] == "disturbed"
        assert figures["others"] == ["nav/pose (/flight, /foreign)"]
        with pytest.raises(ProcessError, match="nav/pose .*/foreign.*another ROS_DOMAIN_ID"):
            fly_live(SEED, settings, tmp_path, domain=DOMAIN)
