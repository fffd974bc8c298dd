# SPDX-License-Identifier: Apache-2.0
"""The same flight with nodes over DDS and in lock-step: only timing differs."""

import json

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.node import Node

from quadtree_lss.cli import main
from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.lab.flight.flight_page import write_flight
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.lab.live import flight, processes
from quadtree_lss.lab.live.flight import fly_live
from quadtree_lss.lab.live.processes import ProcessError, environment_domain, local_domain

SHORT = {"slant_range": 260.0, "speed": 26.0, "half": 8.0, "scatter": 3.0, "survey": 3.0}
SEED = 40049
pytestmark = pytest.mark.xdist_group("ros_flight")  # one flight for all


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    return fly_live(SEED, flight_settings(SHORT), tmp_path_factory.mktemp("live"))


@pytest.mark.slow
def test_safe_landing_with_live_nodes(live):
    figures = live.figures
    assert figures["outcome"] == "touchdown" and figures["safe"], figures
    assert figures["map_said"] in ("safe", "partly_unobserved", "unsafe") and live.last is not None
    assert any(d.what == "target" for d in live.flight.pilot.decisions)


@pytest.mark.slow
def test_its_page_shows_the_targets_that_the_nodes_published(live, tmp_path):
    write_flight(tmp_path, live)
    content = load_results(tmp_path)
    np.testing.assert_allclose(content.positions, live.last.sites.position, atol=1e-6)
    assert len(content.selected["id"]) == len(live.targets) > 0


def test_other_publishers_of_the_same_topics_are_named(tmp_path):
    with local_domain(tmp_path) as number:
        pass
    rclpy.init(context=(context := Context()), domain_id=number)
    try:
        other = Node("foreign", context=context)
        other.create_publisher(PoseWithCovarianceStamped, "nav/pose", 10)
        with pytest.raises(ProcessError, match="nav/pose.*another ROS_DOMAIN_ID"):
            fly_live(SEED, flight_settings(SHORT), tmp_path, domain=number)
    finally:
        context.try_shutdown()


def test_the_domain_is_the_given_one(monkeypatch):
    for text, number in (("", None), ("0", 0), ("42", 42)):
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
        assert environment_domain() == number
    for text in ("x", "-1", "232", "9" * 5000):
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
        with pytest.raises(ProcessError, match="ROS_DOMAIN_ID is"):
            environment_domain()


def test_outcome_of_nodes_that_never_start(tmp_path, capsys, monkeypatch):
    """Over the one that a flight before it left there; the error says how the node ended."""
    monkeypatch.setattr(processes, "program", lambda name: "/bin/false")
    monkeypatch.setattr(flight, "MAX_STARTUP_S", 1.0)
    (path := tmp_path / "touchdown.json").write_text('{"outcome": "touchdown", "safe": true}')
    assert main(["fly", "--seed", str(SEED), "--out", str(tmp_path)]) == 1
    figures = json.loads(path.read_text())
    assert figures["outcome"] == "none" and figures["safe"] is False and figures["seed"] == SEED
    assert "mapping_node ended with exit code 1" in figures["reason"]
    assert figures["reason"] in capsys.readouterr().err
