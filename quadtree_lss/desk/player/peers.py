# SPDX-License-Identifier: Apache-2.0
"""Whom a bag is played to: the player's node, its topics' names, and who listens."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence

from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher

from quadtree_lss.onboard.errors import QuadtreeLssError

MATCH_PAUSE_S = 0.5
"""After a publisher sees its match the subscriber may not be ready yet."""


class PlayError(QuadtreeLssError):
    """The bag cannot be played, or nobody listens."""


def player_node(
    context: Context, namespace: str, remap: Sequence[str], played: Iterable[str]
) -> Node:
    """What publishes.

    Raises:
        PlayError: the namespace or another name is none, or no such topic is played.
    """
    known = [name.lstrip("/") for name in played]
    for rule in remap:
        if rule.partition(":=")[0].lstrip("/") not in known:
            msg = f"--remap {rule}: of the form FROM:=TO, where FROM is one of {', '.join(known)}"
            raise PlayError(msg)
    rules = [f"{name.lstrip('/')}:={to}" for name, _, to in (r.partition(":=") for r in remap)]
    arguments = [item for rule in rules for item in ("-r", rule)]
    try:
        return Node(
            "bag_player",
            context=context,
            namespace=namespace,
            cli_args=["--ros-args", *arguments] if arguments else None,
        )
    except (NameValidationException, rclpy_implementation.RCLError) as error:
        msg = f"--namespace or --remap: {str(error).splitlines()[0].split(', at /')[0]}"
        raise PlayError(msg) from None


def wait_for_subscribers(node: Node, publishers: Sequence[Publisher], wait: float) -> None:
    """Until each publisher has one.

    Raises:
        PlayError: after ``wait`` seconds; names what is subscribed instead.
    """
    deadline = time.monotonic() + wait
    while missing := [p for p in publishers if not p.get_subscription_count()]:
        if time.monotonic() > deadline:
            names = ", ".join(p.topic_name for p in missing)
            msg = f"nobody subscribed to {names} within {wait:g} s: {_subscribed(node, missing)}"
            raise PlayError(msg)
        time.sleep(0.05)
    time.sleep(MATCH_PAUSE_S)


def _subscribed(node: Node, publishers: Sequence[Publisher]) -> str:
    """Which topics of the same types somebody does listen to."""
    kinds = {f"{p.msg_type.__module__.split('.')[0]}/msg/{p.msg_type.__name__}" for p in publishers}
    found = [
        name
        for name, types in node.get_topic_names_and_types()
        if kinds & set(types) and node.count_subscribers(name)
    ]
    if not found:
        return "nor to any topic of these types; are nodes running?"
    return f"subscribed are {', '.join(sorted(found))} (--namespace, --remap FROM:=TO)"
