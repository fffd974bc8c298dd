# SPDX-License-Identifier: Apache-2.0
"""Arrays to rclpy messages and back, filled through ``array.array``, which rclpy takes unlooked."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from quadtree_lss.core.quadtree import CellMap
from quadtree_lss.messages.clouds import stamp_ns
from quadtree_lss.messages.maps import (
    CELL_FIELDS,
    POINT_FIELD_TYPES,
    SITE_FIELDS,
    MapMessageError,
    decode_cells,
    encode_cells,
    encode_hazards,
    encode_observed,
    encode_score,
    encode_sites,
    record_dtype,
    site_orientations,
)

if TYPE_CHECKING:  # the sites' modules are slow to load, and mapping_node needs none
    from quadtree_lss.core.sites import LandingAssessment

Fields = tuple[tuple[str, str], ...]


def time_message(stamp: int) -> Time:
    """Integer nanoseconds to a ROS time."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_message(stamp: int, frame: str) -> Header:
    """Header with a stamp in nanoseconds."""
    return Header(stamp=time_message(stamp), frame_id=frame)


def cloud_message(records: NDArray[np.void], fields: Fields, header: Header) -> PointCloud2:
    """One point per record (M,) of ``record_dtype(fields)``, packed, little endian."""
    kinds = record_dtype(fields)
    offsets = [kinds.fields[name][1] for name, _ in fields] if kinds.fields else []
    cloud = PointCloud2(header=header, height=1, width=len(records), is_dense=False)
    cloud.fields = [
        PointField(name=name, offset=offset, datatype=POINT_FIELD_TYPES[kind], count=1)
        for (name, kind), offset in zip(fields, offsets, strict=True)
    ]
    cloud.point_step = kinds.itemsize
    cloud.row_step = kinds.itemsize * len(records)
    cloud.data = array("B", records.tobytes())
    return cloud


def cloud_records(cloud: Any, fields: Fields) -> NDArray[np.void]:
    """Records (M,) of a cloud that has exactly the layout of ``cloud_message``.

    Raises:
        MapMessageError: other fields, offsets, types or sizes (``layout``).
    """
    kinds = record_dtype(fields)
    wanted = [
        (name, kinds.fields[name][1], POINT_FIELD_TYPES[kind])
        for name, kind in fields
        if kinds.fields
    ]
    found = [(item.name, item.offset, item.datatype) for item in cloud.fields]
    count = cloud.width * cloud.height
    if (
        found != wanted
        or cloud.is_bigendian
        or cloud.point_step != kinds.itemsize
        or len(cloud.data) != count * kinds.itemsize
    ):
        msg = (
            f"cloud of {count} points, {len(cloud.fields)} fields and {cloud.point_step} bytes"
            f" each is not of the layout documented in msg_docs ({len(fields)} fields,"
            f" {kinds.itemsize} bytes)"
        )
        raise MapMessageError("layout", msg)
    return np.frombuffer(cloud.data, dtype=kinds)


def grid_message(
    values: NDArray[np.int8], corner: tuple[float, float], resolution: float, header: Header
) -> OccupancyGrid:
    """Grid of values (ny, nx), row of least y first.

    Args:
        values: int8.
        corner: South-western corner of the first cell, m.
        resolution: Side of a cell, m.
        header: Stamp and frame of the map.
    """
    grid = OccupancyGrid(header=header)
    grid.info.map_load_time = header.stamp
    grid.info.resolution = float(resolution)
    grid.info.height, grid.info.width = values.shape
    grid.info.origin.position.x, grid.info.origin.position.y = map(float, corner)
    grid.info.origin.orientation.w = 1.0
    grid.data = array("b", np.ascontiguousarray(values, dtype=np.int8).tobytes())
    return grid


def map_messages(cells: CellMap, frame: str) -> tuple[PointCloud2, OccupancyGrid]:
    """``map/cells`` and ``map/observed``."""
    header = header_message(cells.stamp_ns, frame)
    domain = cells.domain
    cloud = cloud_message(encode_cells(cells), CELL_FIELDS, header)
    corner = (domain.xmin, domain.ymin)
    values = encode_observed(cells.observed)
    return cloud, grid_message(values, corner, domain.finest_size, header)


def map_from_messages(cloud: Any, grid: Any) -> CellMap:
    """The map of one stamp from ``map/cells`` and ``map/observed``.

    Raises:
        MapMessageError: a message is not what ``mapping_node`` sends.
    """
    records = cloud_records(cloud, CELL_FIELDS)
    values = np.frombuffer(grid.data, dtype=np.int8)
    if values.size != grid.info.height * grid.info.width:
        msg = (
            f"map/observed of {grid.info.width} x {grid.info.height} cells carries"
            f" {values.size} values"
        )
        raise MapMessageError("observed_size", msg)
    observed = values.reshape(grid.info.height, grid.info.width) > 0
    origin = grid.info.origin.position
    return decode_cells(records, observed, origin.x, origin.y, stamp_ns(cloud.header))


def sites_message(assessment: LandingAssessment, frame: str) -> PoseArray:
    """``landing/sites``, best first."""
    sites = assessment.sites
    poses = PoseArray(header=header_message(assessment.stamp_ns, frame))
    for (x, y, z), q in zip(
        sites.position.tolist(), site_orientations(sites.normal).tolist(), strict=True
    ):
        orientation = Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
        poses.poses.append(Pose(position=Point(x=x, y=y, z=z), orientation=orientation))
    return poses


def site_table_message(assessment: LandingAssessment, frame: str) -> PointCloud2:
    """``landing/site_table``, in the order of ``landing/sites``."""
    header = header_message(assessment.stamp_ns, frame)
    return cloud_message(encode_sites(assessment), SITE_FIELDS, header)


def landing_grids(assessment: LandingAssessment, frame: str) -> tuple[OccupancyGrid, OccupancyGrid]:
    """``landing/hazards`` and ``landing/score``; grid nodes are the centres of their cells."""
    header = header_message(assessment.stamp_ns, frame)
    x, y = assessment.x, assessment.y
    spacing = float(x[1] - x[0]) if len(x) > 1 else 1.0
    corner = (float(x[0]) - 0.5 * spacing, float(y[0]) - 0.5 * spacing)
    hazards, score = encode_hazards(assessment), encode_score(assessment)
    return (
        grid_message(hazards, corner, spacing, header),
        grid_message(score, corner, spacing, header),
    )
