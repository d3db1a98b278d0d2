"""Clouds in PLY and PCD: dialects that are to be read, and faults that are to be told."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
import struct

from continuum_loc.formats.shapes import Cloud
import numpy as np
from studies._input_case import ANYTHING, Case, EITHER, READ, REFUSED
from studies._input_files import (
    cloud_points,
    COUNT,
    CUTS,
    DOUBLES,
    file_case,
    flipped,
    FLIPS,
    LINE_ENDS,
    PLY_FORMS,
    same,
)
from studies.support import dialects
from studies.support.dialects import Columns, xyz

PCD_FORMS = ('ascii', 'binary', 'binary_compressed')
TYPES = (('f4', 'f4', 'f4'), DOUBLES, ('f8', 'f4', 'f4'))


def cloud_cases(seed: int) -> Iterator[Case]:
    """All clouds with a header."""
    rng = np.random.default_rng(seed)
    points = cloud_points(rng)
    yield from _clouds(points)
    yield from _fields(points)
    yield from _cloud_faults(points, rng)
    yield from _headers(points)


def _stored(points: np.ndarray, types: Sequence[str], ascii_form: bool) -> np.ndarray:
    """Give the points as a file of these types holds them."""
    if ascii_form:
        return points
    columns = [points[:, k].astype(kind).astype(np.float64) for k, kind in enumerate(types)]
    return np.column_stack(columns)


def _clouds(points: np.ndarray) -> Iterator[Case]:
    for form, types, (end, newline) in product(PLY_FORMS, TYPES, LINE_ENDS.items()):
        yield file_case(
            'cloud',
            f'PLY {form}, {"/".join(types)}, {end}',
            'cloud.ply',
            dialects.ply(
                xyz(points, types), form, newline=newline, head=['comment a', 'obj_info b']
            ),
            READ,
            same(_stored(points, types, form == 'ascii')),
        )
    for form, types, pads in product(PCD_FORMS, TYPES, (0, 1, 2)):
        columns = dict(xyz(points, types))
        for pad in range(pads):
            columns |= {f'_{4 + 8 * pad}': ('u1', np.zeros(COUNT))}
            columns |= {f'field{pad}': ('f4', np.ones(COUNT))}
        yield file_case(
            'cloud',
            f'PCD {form}, {"/".join(types)}, {pads} paddings',
            'cloud.PCD' if pads else 'cloud.pcd',
            dialects.pcd(columns, form),
            READ,
            same(_stored(points, types, form == 'ascii'), noted='field0' if pads else ''),
        )


def _fields(points: np.ndarray) -> Iterator[Case]:
    """Write normals, colours and holes, by their names."""
    normals = np.tile([0.0, 0.6, 0.8], (COUNT, 1))
    mixed = normals * np.where(np.arange(COUNT) == 7, 0.5, 1.0)[:, None]
    holes = points.copy()
    holes[::7] = np.nan
    for suffix, form in (
        ('ply', PLY_FORMS[1]),
        ('ply', 'ascii'),
        ('pcd', 'binary'),
        ('pcd', 'ascii'),
    ):
        write = dialects.ply if suffix == 'ply' else dialects.pcd
        doubles = xyz(points, DOUBLES)
        where = f'{suffix.upper()} {form}'
        for name, values, right, judge in (
            ('normals', normals, READ, _has_normals(normals)),
            (
                'normals of length 5',
                5.0 * normals,
                READ,
                same(points, noted='normals left aside'),
            ),
            (
                'normals of length 0',
                0.0 * normals,
                READ,
                same(points, noted='normals left aside'),
            ),
            ('one normal of length 0.5', mixed, REFUSED, None),
        ):
            columns = doubles | _named(('nx', 'ny', 'nz'), values)
            data = write(columns, form)
            yield file_case('cloud', f'{where}, {name}', f'cloud.{suffix}', data, right, judge)
        columns = doubles | {name: ('u1', np.arange(COUNT)) for name in ('red', 'green', 'blue')}
        yield file_case(
            'cloud',
            f'{where}, colours',
            f'cloud.{suffix}',
            write(columns, form),
            READ,
            same(points, noted='left aside: red, green, blue'),
        )
        right, left = (
            (REFUSED, None) if suffix == 'ply' else (READ, points[np.isfinite(holes[:, 0])])
        )
        yield file_case(
            'cloud',
            f'{where}, points without coordinates',
            f'cloud.{suffix}',
            write(xyz(holes, DOUBLES), form),
            right,
            None if left is None else same(left, noted='left out'),
        )


def _named(names: Sequence[str], values: np.ndarray) -> Columns:
    return {name: ('f8', values[:, k]) for k, name in enumerate(names)}


def _has_normals(normals: np.ndarray) -> Callable[[Cloud], str]:
    def judge(cloud: Cloud) -> str:
        if cloud.normals is None:
            return 'no normals'
        return '' if np.array_equal(cloud.normals, normals) else 'other normals'

    return judge


def _cloud_faults(points: np.ndarray, rng: np.random.Generator) -> Iterator[Case]:
    whole = {
        **{f'PLY {form}': (dialects.ply(xyz(points), form), 'ply') for form in PLY_FORMS},
        **{f'PCD {form}': (dialects.pcd(xyz(points), form), 'pcd') for form in PCD_FORMS},
    }
    for name, (data, suffix) in whole.items():
        stored = _stored(points, TYPES[0], 'ascii' in name)
        for cut in rng.integers(0, len(data), CUTS):
            part = data[:cut]
            yield file_case(
                'cloud', f'{name}, cut at byte {cut}', f'cut.{suffix}', part, EITHER, same(stored)
            )
        for _ in range(FLIPS):
            yield file_case(
                'cloud',
                f'{name}, bytes changed in transmission',
                f'flipped.{suffix}',
                flipped(data, rng),
                ANYTHING,
            )
        ascii_form = 'ascii' in name
        more = b'0 0 0\n' if ascii_form else bytes(12)
        yield file_case(
            'cloud', f'{name}, a point too many', f'more.{suffix}', data + more, REFUSED
        )
    for form, count in product(PLY_FORMS, (10**12, 61, 59, -60, '6e1')):
        data = dialects.ply(xyz(points), form, count=count)
        yield file_case('cloud', f'PLY {form} says {count} points', 'lying.ply', data, REFUSED)
    for form, count in product(PCD_FORMS, (10**12, 61, 59, -60, '6e1')):
        data = dialects.pcd(xyz(points), form, count=count)
        yield file_case('cloud', f'PCD {form} says {count} points', 'lying.pcd', data, REFUSED)


def _headers(points: np.ndarray) -> Iterator[Case]:
    """Headers that are damaged by one word."""
    ply, pcd = dialects.ply(xyz(points)), dialects.pcd(xyz(points))
    for suffix, data, old, new in (
        ('ply', ply, b'ply\n', b'plx\n'),
        ('ply', ply, b'format ascii 1.0\n', b''),
        ('ply', ply, b'ascii', b'ebcdic'),
        ('ply', ply, b'float z', b'float y'),
        ('ply', ply, b'property float z\n', b''),
        ('ply', ply, b'float z', b'quad z'),
        ('ply', ply, b'end_header', b'ende'),
        ('ply', ply, b'element vertex', b'element point'),
        ('pcd', pcd, b'SIZE 4 4 4', b'SIZE 4 4 8'),
        ('pcd', pcd, b'SIZE 4 4 4', b'SIZE 4 4 3'),
        ('pcd', pcd, b'SIZE 4 4 4', b'SIZE 4 4'),
        ('pcd', pcd, b'TYPE F F F', b'TYPE F F C'),
        ('pcd', pcd, b'COUNT 1 1 1', b'COUNT 1 1 2'),
        ('pcd', pcd, b'FIELDS x y z', b'FIELDS x y y'),
        ('pcd', pcd, b'HEIGHT 1', b'HEIGHT 60'),
        ('pcd', pcd, b'DATA binary', b'DATA binary_zip'),
        ('pcd', pcd, b'VIEWPOINT 0 0 0', b'VIEWPOINT a b c'),
    ):
        name = (
            f'{suffix.upper()} header: {old.decode().strip()} -> {new.decode().strip() or "none"}'
        )
        yield file_case('cloud', name, f'header.{suffix}', data.replace(old, new, 1), REFUSED)
    packed = dialects.pcd(xyz(points), 'binary_compressed')
    start = packed.index(b'_compressed\n') + len(b'_compressed\n')
    sizes = struct.unpack_from('<II', packed, start)
    for change in ((1, 0), (-1, 0), (0, 12), (0, 2**31), (2**31, 2**31)):
        lying = struct.pack('<II', *(a + b for a, b in zip(sizes, change, strict=True)))
        after = start + 8
        data = packed[:start] + lying + packed[after:]
        yield file_case(
            'cloud', f'PCD compressed, sizes changed by {change}', 'lzf.pcd', data, REFUSED
        )
