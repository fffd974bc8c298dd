# SPDX-License-Identifier: Apache-2.0
"""Conversion of maps and assessments to output messages, and of map messages to maps.

The message classes, of rclpy or rosbags, are passed in by name and called with all fields.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages import maps
from quadtree_lss.onboard.messages.clouds import MessageError, stamp_ns

if TYPE_CHECKING:  # the sites' modules are slow to load, and mapping_node needs none
    from quadtree_lss.onboard.core.landing.result import LandingAssessment

CELLS, OBSERVED = "map/cells", "map/observed"
SITES, SITE_TABLE = "landing/sites", "landing/site_table"
HAZARDS, SCORE, PROBABILITY = "landing/hazards", "landing/score", "landing/probability"
GROUND = SITES, SITE_TABLE, HAZARDS, SCORE, PROBABILITY
SELECTED, STATUS = "landing/selected", "landing/status"
STATUS_TEXT = "landing/status_text"  # live only

GRIDS = {
    HAZARDS: maps.encode_hazards,
    SCORE: maps.encode_score,
    PROBABILITY: maps.encode_probability,
}
CLOUD_TYPE, GRID_TYPE = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid"
POSES_TYPE = "geometry_msgs/msg/PoseArray"
SELECTED_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TOPIC_TYPES = {
    CELLS: CLOUD_TYPE,
    OBSERVED: GRID_TYPE,
    SITES: POSES_TYPE,
    SITE_TABLE: CLOUD_TYPE,
    HAZARDS: GRID_TYPE,
    SCORE: GRID_TYPE,
    PROBABILITY: GRID_TYPE,
    SELECTED: SELECTED_TYPE,
    STATUS: CLOUD_TYPE,
}
"""Relative names of the outputs and their types."""

GRID_MAP, GRID_MAP_TYPE = "landing/grid_map", "grid_map_msgs/msg/GridMap"
"""Sent live where ``grid_map_msgs`` is installed, and always recorded."""
RECORDED_TYPES = {**TOPIC_TYPES, GRID_MAP: GRID_MAP_TYPE}
GRID_MAP_LAYERS = "elevation plane_elevation slope_deg hazard safe score probability".split()
"""Layers of `GRID_MAP`."""

Fields = np.dtype[np.void]
TopicMessage = tuple[str, Any]
"""Relative name of a topic, and a message."""


def point_layout(fields: Fields) -> list[tuple[str, int, int]]:
    """Return name, offset and PointField datatype of each field."""
    types, by_name = maps.POINT_FIELD_TYPES, (fields.fields or {}).items()
    return [(name, start, types[kind.str[1:]]) for name, (kind, start, *_) in by_name]


def cloud_records(cloud: Any, fields: Fields) -> NDArray[np.void]:
    """View a PointCloud2 with the layout of `MessageMaker.cloud` as records (M,). Raises
    `MessageError` with reason ``layout`` if fields, offsets, types or sizes differ."""
    layout = point_layout(fields)
    found = [(item.name, item.offset, item.datatype) for item in cloud.fields]
    count = cloud.width * cloud.height
    sizes = cloud.point_step, len(cloud.data)
    if cloud.is_bigendian or found != layout or sizes != (fields.itemsize, count * fields.itemsize):
        msg = f"cloud of {count} points, {len(found)} fields and {cloud.point_step} bytes each"
        msg += " is not of the layout documented in msg_docs"
        raise MessageError("layout", f"{msg} ({len(layout)} fields, {fields.itemsize} bytes)")
    return np.frombuffer(cloud.data, dtype=fields)


def status_from_message(cloud: Any) -> np.void:
    """Return the record of ``landing/status``. Raises `MessageError` with reason ``layout`` if it
    has another layout or number of points."""
    records = cloud_records(cloud, maps.STATUS_FIELDS)
    if len(records) != 1:
        raise MessageError("layout", f"{STATUS} has {len(records)} points; 1 is needed")
    record: np.void = records[0]
    return record


def map_from_messages(cloud: Any, grid: Any, lss: LssConfig | None = None) -> CellMap:
    """Build the map from ``map/cells`` (``cloud``) and ``map/observed`` (``grid``) of one stamp.
    ``lss``: as in `maps.decode_cells`. Raises `MessageError`: a message is not one of
    ``mapping_node``, or their frames differ (``frame``)."""
    frames = (str(cloud.header.frame_id), str(grid.header.frame_id))
    if frames[0].lstrip("/") != frames[1].lstrip("/"):
        shown = [one_line(frame, 80) for frame in frames]
        msg = f"map/cells is in frame '{shown[0]}', map/observed in '{shown[1]}'"
        raise MessageError("frame", msg)
    records = cloud_records(cloud, maps.CELL_FIELDS)
    values = np.frombuffer(grid.data, dtype=np.int8)
    if values.size != grid.info.height * grid.info.width:
        cells = f"{grid.info.width} x {grid.info.height} cells"
        msg = f"map/observed of {cells} carries {values.size} values"
        raise MessageError("observed_size", msg)
    shape = grid.info.height, grid.info.width
    observed, known = (mask.reshape(shape) for mask in maps.decode_observed(values))
    origin, stamp = grid.info.origin.position, stamp_ns(cloud.header)
    return maps.decode_cells(records, observed, origin.x, origin.y, stamp, lss, known)


class MessageMaker:
    """Builds the output messages.

    ``types``: message classes by name, as ``nav_msgs/msg/OccupancyGrid``. ``pack``: converts an
    array of uint8, int8 or float32 to the type that the classes need. ``frame``: of the map.
    """

    def __init__(
        self,
        types: Mapping[str, Callable[..., Any]],
        pack: Callable[[NDArray[Any]], Any],
        frame: str,
    ) -> None:
        self._types, self._pack, self._frame = types, pack, frame
        self._layouts: dict[Fields, list[Any]] = {}

    def of_map(self, cells: CellMap) -> Iterator[TopicMessage]:
        yield CELLS, self.cloud(maps.encode_cells(cells), cells.stamp_ns)
        values = maps.encode_observed(cells.observed, cells.known)
        domain = cells.domain
        corner = domain.xmin, domain.ymin
        yield OBSERVED, self.grid(values, corner, domain.finest_size, cells.stamp_ns)

    def of_ground(
        self, assessment: LandingAssessment, topics: Collection[str] = GROUND
    ) -> Iterator[TopicMessage]:
        """Yield grids and sites on the given topics; grid points are the centres of grid cells."""
        stamp, x, y = assessment.stamp_ns, assessment.x, assessment.y
        spacing = float(x[1] - x[0]) if len(x) > 1 else 1.0
        corner = (float(x[0]) - 0.5 * spacing, float(y[0]) - 0.5 * spacing)
        for topic, encode in GRIDS.items():
            if topic in topics:
                yield topic, self.grid(encode(assessment), corner, spacing, stamp)
        if SITE_TABLE in topics:
            yield SITE_TABLE, self.cloud(maps.encode_sites(assessment), stamp)
        if SITES in topics:
            sites = assessment.sites
            turns = maps.site_orientations(sites.normal)
            poses = [self._pose(p, q) for p, q in zip(sites.position, turns, strict=True)]
            yield SITES, self._make(POSES_TYPE, header=self._header(stamp), poses=poses)

    def grid_map(self, assessment: LandingAssessment) -> Any:
        """Build ``landing/grid_map``: the layers of the landing grid, NaN where unknown."""
        x, y = assessment.x, assessment.y
        spacing = float(x[1] - x[0]) if len(x) > 1 else 1.0
        layers = {name: getattr(assessment, name) for name in GRID_MAP_LAYERS}
        layers["probability"] = maps.known_probability(assessment)
        middle = (0.5 * float(x[0] + x[-1]), 0.5 * float(y[0] + y[-1]), 0.0)
        info = self._make(
            "grid_map_msgs/msg/GridMapInfo",
            resolution=spacing,
            length_x=spacing * len(x),
            length_y=spacing * len(y),
            pose=self._pose(middle, (0.0, 0.0, 0.0, 1.0)),
        )
        return self._make(
            GRID_MAP_TYPE,
            header=self._header(assessment.stamp_ns),
            info=info,
            layers=list(layers),
            basic_layers=["elevation"],
            data=[self.grid_map_layer(values) for values in layers.values()],
            outer_start_index=0,
            inner_start_index=0,
        )

    def grid_map_layer(self, values: NDArray[Any]) -> Any:
        """Build a layer column by column, row 0 at the greatest x, column 0 at the greatest y."""
        ny, nx = values.shape
        dimensions = [
            self._make("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=stride)
            for label, size, stride in (("column_index", ny, ny * nx), ("row_index", nx, nx))
        ]
        layout = self._make("std_msgs/msg/MultiArrayLayout", dim=dimensions, data_offset=0)
        turned = np.ascontiguousarray(values[::-1, ::-1], np.float32).ravel()
        return self._make("std_msgs/msg/Float32MultiArray", layout=layout, data=self._pack(turned))

    def of_target(self, assessment: LandingAssessment, age: float) -> Iterator[TopicMessage]:
        """Yield ``landing/selected`` and ``landing/status``. ``age``: of the map, s, or NaN."""
        target, stamp = assessment.selected, assessment.stamp_ns
        turn = maps.site_orientations(target.site.normal)[0] if target.id else (0.0, 0.0, 0.0, 1.0)
        yield SELECTED, self.pose(stamp, target.position, turn, target.covariance.ravel())
        yield STATUS, self.cloud(maps.encode_status(assessment, age), stamp)

    def cloud(self, records: NDArray[np.void], stamp: int) -> Any:
        """Build a PointCloud2 from packed records (M,) or (H, W)."""
        size = records.dtype.itemsize
        height, width = records.shape if records.ndim == 2 else (1, len(records))
        return self._make(
            CLOUD_TYPE,
            header=self._header(stamp),
            height=height,
            width=width,
            fields=self._point_fields(records.dtype),
            is_bigendian=False,
            point_step=size,
            row_step=size * width,
            data=self._pack(np.ascontiguousarray(records).view(np.uint8).reshape(-1)),
            is_dense=False,
        )

    def grid(
        self, values: NDArray[np.int8], corner: tuple[float, float], side: float, stamp: int
    ) -> Any:
        """Build an OccupancyGrid from values (ny, nx), row of least y first. ``corner``: the
        south-western one, m. ``side``: of a cell, m."""
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(stamp),
            resolution=float(side),
            width=values.shape[1],
            height=values.shape[0],
            origin=self._pose((*corner, 0.0), (0.0, 0.0, 0.0, 1.0)),
        )
        data = self._pack(np.ascontiguousarray(values, dtype=np.int8).ravel())
        return self._make(GRID_TYPE, header=self._header(stamp), info=info, data=data)

    def pose(self, stamp: int, position: Any, xyzw: Any, covariance: Array) -> Any:
        """Build a PoseWithCovarianceStamped from position (3,), quaternion and covariance (36,)."""
        pose = self._make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=self._pose(position, xyzw),
            covariance=covariance,
        )
        return self._make(SELECTED_TYPE, header=self._header(stamp), pose=pose)

    def _point_fields(self, fields: Fields) -> list[Any]:
        """Return the PointFields, cached because building them takes longer than the data."""
        if fields not in self._layouts:
            self._layouts[fields] = [
                self._make(
                    "sensor_msgs/msg/PointField", name=name, offset=start, datatype=kind, count=1
                )
                for name, start, kind in point_layout(fields)
            ]
        return self._layouts[fields]

    def _make(self, kind: str, /, **values: Any) -> Any:
        return self._types[kind](**values)

    def _time(self, stamp: int) -> Any:
        seconds, nanoseconds = divmod(int(stamp), 10**9)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def _header(self, stamp: int) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(stamp), frame_id=self._frame)

    def _pose(self, position: Any, xyzw: Any) -> Any:
        x, y, z = map(float, position)
        a, b, c, d = map(float, xyzw)
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=a, y=b, z=c, w=d),
        )
