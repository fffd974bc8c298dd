# SPDX-License-Identifier: Apache-2.0
"""Messages made of plain attributes, as a publisher with any layout would send them."""

from types import SimpleNamespace

import numpy as np

DATATYPES = {"f4": 7, "f8": 8, "i4": 5, "u4": 6, "u1": 2}


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
    filler=0xA5,
    times=None,
):
    """A cloud of points (H, W, 3) or (N, 3); ``gap`` bytes after each field, junk in between.

    ``times`` are a field's name, its kind and its values (H, W) or (N,).
    """
    points = np.asarray(points, dtype=np.float64)
    grid = points if points.ndim == 3 else points[None]
    height, width, _ = grid.shape
    columns = [grid[..., k] for k in range(3)]
    if times is not None:
        names, kinds = (*names, times[0]), (*kinds, times[1])
        columns.append(np.reshape(times[2], (height, width)))
    offsets, offset = [], lead
    for kind in kinds:
        offsets.append(offset)
        offset += int(kind[1]) + gap
    point_step, row_step = offset, offset * width + row_padding
    data = np.full(height * row_step, filler, dtype=np.uint8)
    for k, (kind, start) in enumerate(zip(kinds, offsets, strict=True)):
        if not data.size:
            break
        view = np.ndarray(
            (height, width),
            dtype=order + kind,
            buffer=data,
            offset=start,
            strides=(row_step, point_step),
        )
        view[...] = columns[k]
    fields = [
        SimpleNamespace(name=name, offset=start, datatype=DATATYPES[kind], count=1)
        for name, kind, start in zip(names, kinds, offsets, strict=True)
    ]
    return SimpleNamespace(
        header=header(stamp_ns, "lidar"),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=order == ">",
        point_step=point_step,
        row_step=row_step,
        data=container(data),
        is_dense=False,
    )


def pose(stamp_ns=0, position=(1.0, 2.0, 3.0), xyzw=(0, 0, 0, 1), covariance=None, frame="map"):
    if covariance is None:
        covariance = np.diag([0.04, 0.04, 0.09, 1e-6, 1e-6, 1e-6])
    x, y, z = position
    qx, qy, qz, qw = xyzw
    at = SimpleNamespace(
        position=SimpleNamespace(x=x, y=y, z=z), orientation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
    )
    held = SimpleNamespace(pose=at, covariance=np.asarray(covariance, dtype=float).reshape(-1))
    return SimpleNamespace(header=header(stamp_ns, frame), pose=held)
