# SPDX-License-Identifier: Apache-2.0
"""The nodes' executor: everything of a node is served, and nothing wakes it for nothing."""

import threading
import time

import pytest
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from quadtree_lss.onboard.nodes.executor import OneNodeExecutor, WhenWanted, arrived, steady_timer
from quadtree_lss.onboard.nodes.qos import stream, subscribe

pytestmark = pytest.mark.xdist_group("ros_executor")


@pytest.fixture
def executor(node):
    result = OneNodeExecutor(context=node.context)
    result.add_node(node)
    yield result
    result.shutdown()


def agree(request, answer):
    answer.success = True
    return answer


def spin(executor, until, limit=10.0):
    end = time.monotonic() + limit
    while not until():
        assert time.monotonic() < end
        executor.spin_once(0.1)


def asleep(executor) -> threading.Thread:
    """A thread in which the executor waits for something to do, and goes on to wait."""
    thread = threading.Thread(target=executor.spin_once, args=(60.0,))
    thread.start()
    thread.join(0.3)
    assert thread.is_alive()
    return thread


def awake(executor, thread) -> None:
    """Until the executor came back."""
    executor.wake()
    thread.join(30.0)
    assert not thread.is_alive()


def test_messages_timers_events_services_and_answers_are_served(node, executor):
    heard, ticks, matches = [], [], []
    subscribe(node, Int32, "numbers", heard.append, stream(9, reliable=True), matches.append)
    sender = node.create_publisher(Int32, "numbers", stream(9, reliable=True))
    timer = node.create_timer(0.01, lambda: ticks.append(1))
    node.create_service(Trigger, "ask", agree)
    spin(executor, lambda: matches == [1])
    for number in range(5):
        sender.publish(Int32(data=number))
    spin(executor, lambda: len(heard) == 5 and len(ticks) > 3)
    assert [message.data for message in heard] == list(range(5))
    client = node.create_client(Trigger, "ask")
    spin(executor, client.service_is_ready)
    future = client.call_async(Trigger.Request())
    spin(executor, future.done)
    assert future.result().success
    node.destroy_timer(timer)
    count = len(ticks)
    for _ in range(10):
        executor.spin_once(0.02)
    assert len(ticks) == count


@pytest.mark.parametrize("make", [Node.create_timer, steady_timer])
def test_a_timer_that_another_callback_cancels_or_destroys_is_not_called(node, executor, make):
    called = []

    def end_others():
        called.append("first")
        first.cancel()
        cancelled.cancel()
        node.destroy_timer(destroyed)

    first = make(node, 0.05, end_others)
    cancelled = make(node, 0.05, lambda: called.append("cancelled"))
    destroyed = make(node, 0.05, lambda: called.append("destroyed"))
    executor.spin_once(0.0)
    time.sleep(0.1)  # all three are due
    for _ in range(5):
        executor.spin_once(0.01)
    assert called == ["first"]


def test_a_timer_on_a_steady_clock_wakes_the_node_when_it_is_due_not_when_it_is_reset(
    node, executor
):
    ticks = []
    timer = steady_timer(node, 60.0, lambda: ticks.append(1))
    for _ in range(20):  # whatever the middleware still has to say
        executor.spin_once(0.05)
    timer.reset()
    awake(executor, asleep(executor))
    timer.timer_period_ns = 50_000_000
    timer.reset()
    executor.spin_once(10.0)
    executor.spin_once(10.0)
    assert len(ticks) == 2


def test_what_is_not_wanted_neither_wakes_the_node_nor_is_served(node, executor):
    heard, wanted = [], []
    group = WhenWanted(lambda: bool(wanted))
    subscribe(node, Int32, "ahead", heard.append, stream(9, reliable=True), group=group)
    sender = node.create_publisher(Int32, "ahead", stream(9, reliable=True))
    spin(executor, sender.get_subscription_count)
    sender.publish(Int32(data=1))
    for _ in range(20):  # whatever the middleware still has to say
        executor.spin_once(0.05)
    thread = asleep(executor)
    assert not heard
    wanted.append(True)
    awake(executor, thread)
    spin(executor, lambda: heard)


def test_what_is_not_wanted_is_there_for_who_asks(node, executor):
    group, heard = WhenWanted(lambda: False), []
    ahead = subscribe(node, Int32, "ahead", heard.append, stream(3, reliable=True), group=group)
    sender = node.create_publisher(Int32, "ahead", stream(9, reliable=True))
    spin(executor, sender.get_subscription_count)
    taken = []
    for number in range(5):
        sender.publish(Int32(data=number))
    end = time.monotonic() + 10.0
    while 4 not in taken and time.monotonic() < end:
        taken += [message.data for message in arrived(ahead)]
    assert taken == sorted(taken) and taken[-1] == 4 and not heard
    assert not list(arrived(ahead))


def test_after_a_callback_the_node_sleeps(node, executor):
    """rclpy's own executor wakes once more after each callback, and looks through the node."""
    ticks = []
    timer = node.create_timer(0.05, lambda: (ticks.append(1), timer.cancel()))
    spin(executor, lambda: ticks)
    awake(executor, asleep(executor))


def test_errors_of_callbacks_and_a_shut_down_context_reach_the_caller(node, executor):
    def fail():
        raise ValueError("broken")

    timer = node.create_timer(0.01, fail)
    with pytest.raises(ValueError, match="broken"):
        spin(executor, lambda: False)
    node.destroy_timer(timer)

    async def waits():
        await rclpy.task.Future()

    timer = node.create_timer(0.01, waits)
    with pytest.raises(RuntimeError, match="waits"):
        spin(executor, lambda: False)
    node.destroy_timer(timer)
    node.create_timer(0.01, node.context.try_shutdown)
    with pytest.raises(ExternalShutdownException):
        spin(executor, lambda: False)
