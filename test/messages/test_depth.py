# SPDX-License-Identifier: Apache-2.0
"""Depth images to points: units, rays, decimation, edges, what is refused."""

import dataclasses

import numpy as np
import pytest

from quadtree_lss.lab.simulation.recording import Messages
from quadtree_lss.onboard.config.sections import LidarConfig
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.messages import depth
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.depth import DepthCamera
from quadtree_lss.onboard.messages.intake import Intake

H, W, F = 48, 64, 50.0
MAKE = Messages()


def camera(**values):
    lidar = LidarConfig(**{"range_noise": 0.01, **values})
    found = DepthCamera(lidar)
    found.on_info(MAKE.camera(1, H, W, F))
    return found


def plane():
    """Depths of a tilted plane, and its points."""
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    x, y = (u - 31.5) / F, (v - 23.5) / F
    z = 5.0 / (1.0 - 0.3 * x + 0.2 * y)
    return z, np.stack([x * z, y * z, z], axis=-1)


def test_millimetres_and_metres_are_the_same_points():
    z, points = plane()
    np.testing.assert_allclose(camera().points(MAKE.depth(1, z)), points, atol=7e-4)
    image = MAKE.depth(1, z)
    for order, big in (("<f4", 0), (">f4", 1)):
        padded = np.zeros((H, W + 3), order)
        padded[:, :W] = z
        floats = dataclasses.replace(
            image, encoding="32FC1", is_bigendian=big, step=4 * (W + 3),
            data=np.frombuffer(padded.tobytes(), np.uint8),
        )  # fmt: skip
        np.testing.assert_allclose(camera().points(floats), points, atol=1e-5)


@pytest.mark.parametrize("step", [1, 2])
def test_pixels_between_near_and_far_are_dropped_and_counted(monkeypatch, step):
    monkeypatch.setattr(depth, "COLUMNS", W // step)
    z = np.full((H, W), 5.0)
    z[:, 31:] = 3.0
    z[:, 30] = 4.0  # on neither
    z[10, 50] = np.nan
    seen = camera()
    points = seen.points(MAKE.depth(1, z))
    column = np.arange(step // 2, W, step)
    gone = np.isnan(points[..., 2])
    assert seen.edges == (H if step == 1 else 0) == np.count_nonzero(gone[:, column == 30])
    assert np.count_nonzero(gone) == seen.edges + (step == 1)
    z[:, 30], z[:, 29] = 3.0, 4.0
    seen.points(MAKE.depth(1, z))
    assert seen.edges == H // step


def test_noise_of_stereo_is_no_edge():
    """At 10 m neighbours differ by decimetres; a plane seen at 20 degrees is one, too."""
    rng = np.random.default_rng(1)
    z = np.full((H, W), 10.0) + rng.normal(0.0, 0.1 * 100.0 / (F * 0.5), (H, W))
    seen = camera(stereo_noise=0.1 / (F * 0.5))
    seen.points(MAKE.depth(1, z))
    assert seen.edges < 3
    plain = camera()
    plain.points(MAKE.depth(1, z))
    assert plain.edges < 3, "pixels are wide at 10 m"
    x = (np.arange(W) - 31.5) / F
    inclined = np.broadcast_to(4.0 / (1.0 - np.tan(np.radians(55.0)) * x[::-1] * 0.5), (H, W))
    plain.points(MAKE.depth(1, inclined))
    assert plain.edges == 0


def test_what_cannot_be_used_is_told():
    z, _ = plane()
    image = MAKE.depth(1, z)
    with pytest.raises(MessageError, match="before any depth/camera_info"):
        DepthCamera(LidarConfig()).points(image)
    for change, text in (
        ({"encoding": "rgb8"}, "encoding 'rgb8'"),
        ({"data": image.data[:-1]}, "bytes"),
        ({"height": H - 1}, "camera_info of"),
        ({"step": 2 * W - 1}, "a row"),
    ):
        with pytest.raises(MessageError, match=text):
            camera().points(dataclasses.replace(image, **change))
    with pytest.raises(MessageError, match="no focal length"):
        camera().on_info(MAKE.camera(1, H, W, 0.0))


def test_intake_takes_images_as_scans_and_tells_edges_apart():
    intake = Intake(Config())
    z, _ = plane()
    z[20, 20] *= 0.8
    z[20, 21] *= 0.6
    intake.on_camera_info(MAKE.camera(1, H, W, F))
    rng = np.eye(6) * 1e-4
    for stamp in (0, 200_000_000):
        pose = MAKE.pose(stamp, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), rng)
        intake.on_pose(pose)
    assert intake.on_cloud(MAKE.depth(100_000_000, z), 0) == 100_000_000
    (scan,) = intake.ready(0)
    assert scan.points_lidar.shape == (H, W, 3) and scan.edges == 1
    lost = scan.lost({"no_return": 1, "range": 0, "isolated": 0, "outside": 4})
    assert lost == {"no_return": 0, "range": 0, "isolated": 0, "outside": 4, "edge": 1}
    intake.on_cloud(dataclasses.replace(MAKE.depth(1, z), encoding="bgr8"), 0)
    assert intake.rejected["cloud_encoding"] == 1
    intake.on_camera_info(MAKE.camera(1, H, W, 1e-300))
    assert intake.rejected["camera_info_focal_length"] == 1
    assert intake.dropped == {"cloud_encoding": 1}, "what is said of images is none"
