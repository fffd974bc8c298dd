# SPDX-License-Identifier: Apache-2.0
"""Messages made of plain attributes, as a publisher with any layout would send them."""

from types import SimpleNamespace

import numpy as np

DATATYPES = {"f4": 7, "f8": 8, "i4": 5, "u4": 6, "u2": 4, "u1": 2}


def header(stamp_ns=0, frame="map"):
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return SimpleNamespace(stamp=stamp, frame_id=frame)


def cloud(
    points,
    *,
    names=("x", "y", "z"),
    kinds=("f4", "f4", "f4"),
    order="<",
    lead=0,
    gap=0,
    row_padding=0,
    stamp_ns=0,
    container=np.asarray,
    times=None,
):
    """A cloud of points (H, W, 3) or (N, 3); ``gap`` bytes after each field, junk in between.

    ``times`` are a field's name, its kind and its values (H, W) or (N,).
    """
    points = np.asarray(points, dtype=np.float64)
    grid = points if points.ndim == 3 else points[None]
    columns = [grid[..., k] for k in range(3)]
    if times is not None:
        names, kinds = (*names, times[0]), (*kinds, times[1])
        columns.append(np.reshape(times[2], grid.shape[:2]))
    offsets = lead + np.cumsum([0, *(int(kind[1]) + gap for kind in kinds)])
    form = {"names": names, "formats": [order + kind for kind in kinds]}
    layout = np.dtype({**form, "offsets": offsets[:-1], "itemsize": offsets[-1]})
    return cloud_of(layout, columns, row_padding, stamp_ns, container)


def cloud_of(layout, columns, row_padding=0, stamp_ns=0, container=np.asarray):
    """A cloud of the fields that a NumPy type has, at its places; what is none of them is junk."""
    height, width = columns[0].shape
    records = np.full((height, width * layout.itemsize), 0xA5, dtype=np.uint8).view(layout)
    for name, values in zip(layout.names, columns, strict=True):
        records[name] = values
    rows = records.view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=0xA5)
    fields = [
        SimpleNamespace(name=name, offset=at, datatype=DATATYPES[kind.str[1:]], count=1)
        for name, (kind, at) in ((name, layout.fields[name]) for name in layout.names)
    ]
    return SimpleNamespace(
        header=header(stamp_ns, "lidar"),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=any(kind.str[0] == ">" for kind, _ in layout.fields.values()),
        point_step=layout.itemsize,
        row_step=rows.shape[1],
        data=container(rows.reshape(-1)),
        is_dense=False,
    )


def xyz(values):
    """A place, or with a fourth number a quaternion."""
    return SimpleNamespace(**dict(zip("xyzw", values, strict=False)))


def transform(stamp_ns, translation, xyzw, parent="body", child="lidar"):
    turned = SimpleNamespace(translation=xyz(translation), rotation=xyz(xyzw))
    head = header(stamp_ns, parent)
    return SimpleNamespace(header=head, child_frame_id=child, transform=turned)


def pose(stamp_ns=0, position=(1.0, 2.0, 3.0), xyzw=(0, 0, 0, 1), covariance=None, frame="map"):
    if covariance is None:
        covariance = np.diag([0.04, 0.04, 0.09, 1e-6, 1e-6, 1e-6])
    at = SimpleNamespace(position=xyz(position), orientation=xyz(xyzw))
    held = SimpleNamespace(pose=at, covariance=np.asarray(covariance, dtype=float).reshape(-1))
    return SimpleNamespace(header=header(stamp_ns, frame), pose=held)
