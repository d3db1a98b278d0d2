"""
PointCloud2 and structured arrays, either way.

Any field order, datatype, padding and byte order is read.
"""

from __future__ import annotations

from typing import Any

from continuum_loc.errors import MessageError
from msg_tools.factory import Messages
import numpy as np

# sensor_msgs/PointField: datatype number -> NumPy scalar.
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
# Rows written at a time: a large cloud would else pass through the processor's cache once for each
# column.
ROWS = 4096
_NUMBER = {np.dtype(code): number for number, code in DATATYPES.items()}


def cloud_message(make: Messages, header: Any, array: np.ndarray) -> Any:
    """
    PointCloud2 of a structured array, (H, W) organised or (N,) not.

    Fields are those of the dtype.
    """
    shape = array.shape if array.ndim == 2 else (1, len(array))
    dense = all(bool(np.isfinite(array[name]).all()) for name in 'xyz')
    return _cloud(make, header, shape, array.dtype, make.octets(array), dense)


def columns_cloud(make: Messages, header: Any, columns: dict[str, np.ndarray]) -> Any:
    """PointCloud2 of columns (N,), x, y and z among them, as float32; written in place."""
    dtype = np.dtype([(name, '<f4') for name in columns])
    count = len(columns['x'])
    data = make.blank(count * dtype.itemsize)
    table = np.frombuffer(data, '<f4').reshape(count, len(columns))
    places, dense = [list(columns).index(name) for name in 'xyz'], True
    for begin in range(0, count, ROWS):
        part = slice(begin, begin + ROWS)
        rows = table[part]
        for number, column in enumerate(columns.values()):
            rows[:, number] = column[part]
        finite = np.isfinite(rows)
        dense = dense and bool(finite.all() or finite[:, places].all())
    return _cloud(make, header, (1, count), dtype, data, dense, **make.uncopied)


def _cloud(
    make: Messages,
    header: Any,
    shape: tuple[int, int],
    dtype: np.dtype,
    data: Any,
    dense: bool,
    **how: Any,
) -> Any:
    fields = [
        make(
            'sensor_msgs/msg/PointField',
            name=name,
            offset=dtype.fields[name][1],
            datatype=_NUMBER[dtype.fields[name][0]],
            count=1,
        )
        for name in dtype.names
    ]
    return make(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=shape[0],
        width=shape[1],
        fields=fields,
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * shape[1],
        data=data,
        is_dense=dense,
        **how,
    )


def cloud_array(message: Any, where: str) -> np.ndarray:
    """
    (H, W) structured array viewing the cloud's bytes.

    Raises MessageError starting with `where`.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    _check_size(message, where)
    rows = np.frombuffer(message.data, np.uint8).reshape(height, int(message.row_step))[
        :, : width * step
    ]
    return np.ascontiguousarray(rows).view(cloud_dtype(message, where)).reshape(height, width)


def cloud_dtype(message: Any, where: str) -> np.dtype:
    """Make the structured dtype which the cloud's fields describe."""
    order = '>' if message.is_bigendian else '<'
    step = int(message.point_step)
    names, formats, offsets = [], [], []
    for item in message.fields:
        _check_field(item, step, names, where)
        names.append(item.name)
        formats.append(order + DATATYPES[item.datatype])
        offsets.append(int(item.offset))
    return np.dtype({'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': step})


def _check_size(message: Any, where: str) -> None:
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    if height * width == 0:
        raise MessageError(
            'empty', f'{where}: the cloud is empty (height {height}, width {width})'
        )
    if step == 0 or int(message.row_step) < step * width:
        raise MessageError(
            'size',
            f'{where}: row_step {message.row_step} must be at least width x point_step = '
            f'{width} x {step}, and point_step greater than 0',
        )
    if len(message.data) != height * int(message.row_step):
        raise MessageError(
            'size',
            f'{where}: data holds {len(message.data)} bytes; height x row_step = '
            f'{height} x {message.row_step} asks for {height * int(message.row_step)}',
        )


def _check_field(item: Any, step: int, taken: list[str], where: str) -> None:
    if item.datatype not in DATATYPES:
        raise MessageError(
            'type', f"{where}: field '{item.name}' has datatype {item.datatype}; valid: 1 to 8"
        )
    if item.name in taken:
        raise MessageError('fields', f"{where}: field '{item.name}' appears twice")
    if item.count not in (0, 1):  # 0 is what some drivers write for a scalar
        raise MessageError(
            'fields', f"{where}: field '{item.name}' has count {item.count}; one value is expected"
        )
    if item.offset + np.dtype(DATATYPES[item.datatype]).itemsize > step:
        raise MessageError(
            'fields',
            f"{where}: field '{item.name}' at offset {item.offset} ends beyond point_step {step}",
        )
