# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss doctor`` on live topics."""

import subprocess

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from ros_scene import cloud, events, pose
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.player import player
from quadtree_lss.lab.live.processes import program
from quadtree_lss.onboard.nodes.qos import latched, stream

pytestmark = pytest.mark.xdist_group("ros")


@pytest.mark.slow
@pytest.mark.parametrize(("frame", "code"), [("map", 0), ("odom", 1)])
def test_doctor_checks_live_topics(ros, frame, code):
    command = [program("quadtree-lss"), "doctor", "--seconds", "4", "--set", f"frames.map={frame}"]
    with ros.listen({}) as listener:
        make = listener.node.create_publisher
        clouds = make(PointCloud2, "lidar/points", stream(5, reliable=False))
        poses = make(PoseWithCovarianceStamped, "nav/pose", stream(100, reliable=True))
        sent = events(60)
        with subprocess.Popen(
            command, env=ros.env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as doctor:
            listener.until(poses.get_subscription_count)
            listener.until(clouds.get_subscription_count)

            def send():
                for _ in range(4):
                    event = next(sent, None)
                    if event is not None and event.points_lidar is None:
                        poses.publish(pose(event.stamp_ns))
                    elif event is not None:
                        clouds.publish(cloud(event.stamp_ns, event.points_lidar))
                return doctor.poll() is not None

            listener.until(send, timeout=60.0)
            out, err = doctor.communicate()
    assert doctor.returncode == code, err
    expected = "nothing is wrong with /lidar/points" if code == 0 else "fix:   frames.map: map"
    assert expected in out, out + err


def test_doctor_reports_silence(ros):
    done = ros.run(program("quadtree-lss"), "doctor", "--seconds", "0.5")
    assert done.returncode == 1 and done.stderr.count("\n") == 2  # what it does, and the result
    assert "no message in 0.5 s" in done.stderr


@pytest.mark.slow
def test_doctor_receives_transforms_of_all_broadcasters(ros, monkeypatch):
    """Use messages of a different type, because no wheel has tf2_msgs."""
    monkeypatch.setattr(player.types, "TRANSFORMS_TYPE", player.types.GIMBAL_TYPE)
    for name, value in ros.env.items():
        monkeypatch.setenv(name, value)
    frames = {f"mount{n}" for n in range(4)}
    with ros.listen({}) as listener:
        for frame in frames:
            static = listener.node.create_publisher(TransformStamped, "tf_static", latched())
            static.publish(TransformStamped(child_frame_id=frame))
        bag = player.listen(4.0)
    assert {decode().child_frame_id for _, _, decode in bag.messages(["/tf_static"])} == frames
