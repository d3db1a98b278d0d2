"""Point clouds with any per-point fields as binary PLY, for Open3D, CloudCompare, MeshLab."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_TYPES = {'f8': 'double', 'f4': 'float', 'i4': 'int', 'u1': 'uchar'}


def write_ply(path: str | Path, fields: dict[str, np.ndarray]) -> None:
    """
    Write one vertex per row of the equally long 1-D `fields`, in their order.

    Valid are float64, float32, int32 and uint8.
    """
    kinds = {name: np.asarray(values).dtype.str[1:] for name, values in fields.items()}
    table = np.empty(
        len(next(iter(fields.values()))),
        dtype=[(name, '<' + kind) for name, kind in kinds.items()],
    )
    for name, values in fields.items():
        table[name] = values
    header = ['ply', 'format binary_little_endian 1.0', f'element vertex {len(table)}']
    header += [f'property {_TYPES[kind]} {name}' for name, kind in kinds.items()]
    Path(path).write_bytes('\n'.join([*header, 'end_header', '']).encode() + table.tobytes())
