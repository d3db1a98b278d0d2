"""What cases of files share: how they are written, and how the points read are judged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from continuum_loc.formats.reading import read_shape
from continuum_loc.formats.shapes import Cloud
from continuum_loc.mapping.prior_map import PriorMap
import numpy as np
from studies._input_case import Case

COUNT = 60  # points of a cloud
DECIMALS = 4
PLY_FORMS = ('ascii', 'binary_little_endian', 'binary_big_endian')
DOUBLES = ('f8', 'f8', 'f8')
LINE_ENDS = {'LF': '\n', 'CRLF': '\r\n', 'CR': '\r'}
CUTS = 5  # places at which each of the files is cut
FLIPS = 4


def cloud_points(rng: np.random.Generator) -> np.ndarray:
    """Draw points (COUNT, 3) as a file of DECIMALS has them."""
    return rng.uniform([-1, -1, 0], [1, 1, 2], (COUNT, 3)).round(DECIMALS)


def file_case(
    kind: str,
    name: str,
    file: str,
    data: bytes | str,
    right: str,
    judge: Callable[[Any], str] | None = None,
) -> Case:
    """Make a case of a file with this content."""
    content = data.encode() if isinstance(data, str) else data

    def write(folder: Path) -> Path:
        path = folder / file
        path.write_bytes(content)
        return path

    return Case(kind, name, write, read_shape, right, judge or anything)


def anything(value: Any) -> str:
    """Find nothing wrong."""
    return ''


def same(points: np.ndarray, *, few: bool = False, noted: str = '') -> Callable[[Cloud], str]:
    """Judge a cloud: these points, or with `few` the first of them; and what it says."""

    def judge(cloud: Cloud | PriorMap) -> str:
        expected = points[: len(cloud.points)] if few else points
        if cloud.points.shape != expected.shape:
            return f'{len(cloud.points)} points in place of {len(points)}'
        off = np.abs(cloud.points - expected).max()
        if off > 0.0:
            return f'coordinates off by {off:.3g}'
        if noted and not any(noted in note for note in cloud.notes):
            return f'nothing said of {noted}: {cloud.notes}'
        return ''

    return judge


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Change three bytes, as a bad transmission does."""
    damaged = bytearray(data)
    for place in rng.integers(0, len(data), 3):
        damaged[place] = rng.integers(256)
    return bytes(damaged)
