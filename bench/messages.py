"""
PointCloud2 messages made and read, beside sensor_msgs_py's way, on the message classes of rclpy.

`run(quick)` gives rows on one core, alternating the two, for a ToF frame of 64 zones and for a map
of 100,000 points with seven columns. The peer is `sensor_msgs_py.point_cloud2` where ROS is
installed. It is not on PyPI: elsewhere `_SensorMsgsPy` stands for it, which does what its
`create_cloud` and `read_points` do (github.com/ros2/common_interfaces, Jazzy), step by step.

Two ways of using it are timed: a structured array, which is its quickest, and points one by one,
as its examples do (`create_cloud` of a list, `read_points_list`). Ours also checks what it reads
(sizes, fields, finite values, that a range is its point's distance), and hands out a `TofFrame` in
float64; the peer's row ends with the same columns in float64, unchecked.
"""

from __future__ import annotations

import array
from collections import namedtuple
from collections.abc import Iterable
from typing import Any

from bench.harness import one_core, side_by_side
from continuum_loc.measurements import TOF_VALID, TofFrame
from msg_tools import convert, geometry, results
from msg_tools.clouds import DATATYPES
from msg_tools.factory import ros_messages
from msg_tools.records import CloudRecord
import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

MAP_POINTS = 100_000
MAP_COLUMNS = ('x', 'y', 'z', 'normal_x', 'normal_y', 'normal_z', 'planarity')
PEER = 'sensor_msgs_py'


def run(quick: bool = False) -> list[dict]:
    """Rows of name, ours_s, peer, peer_s (per message), ratio and spread."""
    repeats = 5 if quick else 25
    with one_core():
        return [*_frame_rows(repeats), *_map_rows(max(repeats // 3, 3))]


def _frame_rows(repeats: int) -> list[dict]:
    peer, make, frame = _peer(), ros_messages(), _frame()
    header = geometry.header_message(make, frame.stamp, frame.sensor)
    message = convert.tof_message(make, frame)
    fields = message.fields
    columns = (*frame.points.T, frame.ranges, frame.sigma, frame.status)

    def structured() -> Any:
        points = np.zeros(len(frame.ranges), peer.dtype_from_fields(fields, 24))
        for name, column in zip(points.dtype.names, columns, strict=True):
            points[name] = column
        return peer.create_cloud(header, fields, points, 24)

    def one_by_one() -> Any:
        return peer.create_cloud(header, fields, list(zip(*columns, strict=True)), 24)

    def read_array() -> TofFrame:
        points = peer.read_points(message)
        xyz = np.column_stack([points[name] for name in 'xyz']).astype(float)
        ranges, sigma = points['range'].astype(float), points['sigma'].astype(float)
        return TofFrame(frame.stamp, frame.sensor, xyz, ranges, sigma, points['status'].copy())

    def read_list() -> TofFrame:
        points = np.array(peer.read_points_list(message), float)
        return TofFrame(
            frame.stamp,
            frame.sensor,
            points[:, :3],
            points[:, 3],
            points[:, 4],
            points[:, 5].astype(np.uint8),
        )

    expected = convert.tof_frame(message)
    made = [convert.tof_frame(theirs()) for theirs in (structured, one_by_one)]
    for other in (*made, read_array(), read_list()):
        if not (np.array_equal(other.points, expected.points) and other.sensor == expected.sensor):
            raise RuntimeError('the peer makes another frame: the comparison would be void')
    write, read = (lambda: convert.tof_message(make, frame)), (lambda: convert.tof_frame(message))
    return [
        side_by_side('message, ToF frame written', write, PEER, structured, repeats),
        side_by_side('message, ToF frame written', write, f'{PEER}, list', one_by_one, repeats),
        side_by_side('message, ToF frame read', read, PEER, read_array, repeats),
        side_by_side('message, ToF frame read', read, f'{PEER}, list', read_list, repeats),
    ]


def _map_rows(repeats: int) -> list[dict]:
    peer, make = _peer(), ros_messages()
    values = np.random.default_rng(0).normal(size=(MAP_POINTS, len(MAP_COLUMNS)))
    record = CloudRecord(1, dict(zip(MAP_COLUMNS, values.T, strict=True)))
    message = results.columns_message(make, record)
    single = values.astype(np.float32)

    def written() -> Any:
        return peer.create_cloud(
            message.header, message.fields, values.astype(np.float32), message.point_step
        )

    def read() -> dict[str, np.ndarray]:
        points = peer.read_points(message)
        return {name: points[name].copy() for name in points.dtype.names}

    if bytes(written().data) != bytes(message.data) or not np.array_equal(
        read()['z'], single[:, 2]
    ):
        raise RuntimeError('the peer writes or reads another map: the comparison would be void')
    return [
        side_by_side(
            'message, map written',
            lambda: results.columns_message(make, record),
            PEER,
            written,
            repeats,
        ),
        side_by_side(
            'message, map read', lambda: results.cloud_record(message), PEER, read, repeats
        ),
    ]


def _frame() -> TofFrame:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(64, 3)).astype(np.float32).astype(float)
    ranges = np.linalg.norm(points, axis=1)
    status = np.full(64, TOF_VALID, np.uint8)
    return TofFrame(10**9, 'ring_1/tof_front', points, ranges, 0.01 * ranges, status)


def _peer() -> Any:
    try:
        from sensor_msgs_py import point_cloud2
    except ImportError:
        return _SensorMsgsPy
    return point_cloud2


class _SensorMsgsPy:
    """The steps of sensor_msgs_py.point_cloud2 that cost time, for machines that have no ROS."""

    @staticmethod
    def dtype_from_fields(fields: Iterable, point_step: int | None = None) -> np.dtype:
        names, offsets, formats = [], [], []
        for i, field in enumerate(fields):
            datatype = np.dtype(DATATYPES[field.datatype])
            name = field.name or f'unnamed_field_{i}'
            for a in range(field.count):
                part = f'{name}_{a}' if field.count > 1 else name
                assert part not in names
                names.append(part)
                offsets.append(field.offset + a * datatype.itemsize)
                formats.append(datatype.str)
        layout = {'names': names, 'formats': formats, 'offsets': offsets}
        return np.dtype(layout if point_step is None else {**layout, 'itemsize': point_step})

    @classmethod
    def create_cloud(cls, header: Any, fields: list, points: Any, point_step: int) -> Any:
        from sensor_msgs.msg import PointCloud2

        dtype = cls.dtype_from_fields(fields, point_step)
        if not isinstance(points, np.ndarray):
            points = np.array(list(map(tuple, points)), dtype=dtype)
        elif points.dtype.names is None:
            points = unstructured_to_structured(points, dtype=dtype)
        assert points.dtype == dtype
        data = array.array('B')
        data.frombytes(memoryview(points).cast('B'))
        cloud = PointCloud2(
            header=header,
            height=1,
            width=len(points),
            is_dense=False,
            is_bigendian=False,
            fields=fields,
            point_step=points.dtype.itemsize,
            row_step=points.dtype.itemsize * len(points),
        )
        cloud.data = data
        return cloud

    @classmethod
    def read_points(cls, cloud: Any) -> np.ndarray:
        return np.ndarray(
            shape=(cloud.width * cloud.height,),
            dtype=cls.dtype_from_fields(cloud.fields, point_step=cloud.point_step),
            buffer=cloud.data,
        )

    @classmethod
    def read_points_list(cls, cloud: Any) -> list:
        kind = namedtuple('Point', [field.name for field in cloud.fields])
        return [kind._make(point) for point in cls.read_points(cloud)]


if __name__ == '__main__':
    for row in run():
        print(row)
