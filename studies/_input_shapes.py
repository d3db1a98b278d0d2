"""Clouds, meshes and our own maps: dialects that are to be read, faults that are to be told."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import gzip
from itertools import product
import json
from pathlib import Path
import struct
from typing import Any
import zipfile

from continuum_loc.mapping.formats.shapes import Cloud, Mesh
from continuum_loc.mapping.map_files import load_map, read_shape
from continuum_loc.mapping.prior_map import NPZ_FORMAT, PriorMap
import numpy as np
from studies._input_case import ANYTHING, Case, EITHER, READ, REFUSED
from studies.support import dialects
from studies.support.dialects import Columns, xyz

COUNT = 60
DECIMALS = 4
PLY_FORMS = ('ascii', 'binary_little_endian', 'binary_big_endian')
PCD_FORMS = ('ascii', 'binary', 'binary_compressed')
TYPES = (('f4', 'f4', 'f4'), ('f8', 'f8', 'f8'), ('f8', 'f4', 'f4'))
CUTS = 5  # places at which each of the files is cut
FLIPS = 4


def shape_cases(seed: int) -> Iterator[Case]:
    """All clouds, meshes and maps."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 0], [1, 1, 2], (COUNT, 3)).round(DECIMALS)
    yield from _clouds(points)
    yield from _cloud_faults(points, rng)
    yield from _tables(points)
    yield from _table_faults(points, rng)
    yield from _meshes(rng)
    yield from _mesh_faults(rng)
    yield from _own_maps(points, rng)


def _case(
    kind: str,
    name: str,
    file: str,
    data: bytes | str,
    right: str,
    judge: Callable[[Any], str] | None = None,
) -> Case:
    content = data.encode() if isinstance(data, str) else data

    def write(folder: Path) -> Path:
        path = folder / file
        path.write_bytes(content)
        return path

    return Case(kind, name, write, read_shape, right, judge or _anything)


def _anything(value: Any) -> str:
    return ''


def _same(points: np.ndarray, *, few: bool = False, noted: str = '') -> Callable[[Cloud], str]:
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


def _stored(points: np.ndarray, types: Sequence[str], ascii_form: bool) -> np.ndarray:
    """Give the points as a file of these types holds them."""
    if ascii_form:
        return points
    columns = [points[:, k].astype(kind).astype(np.float64) for k, kind in enumerate(types)]
    return np.column_stack(columns)


# Clouds


def _clouds(points: np.ndarray) -> Iterator[Case]:
    for form, types, (end, newline) in product(PLY_FORMS, TYPES, _LINE_ENDS.items()):
        yield _case(
            'cloud',
            f'PLY {form}, {"/".join(types)}, {end}',
            'cloud.ply',
            dialects.ply(
                xyz(points, types), form, newline=newline, head=['comment a', 'obj_info b']
            ),
            READ,
            _same(_stored(points, types, form == 'ascii')),
        )
    for form, types, pads in product(PCD_FORMS, TYPES, (0, 1, 2)):
        columns = dict(xyz(points, types))
        for pad in range(pads):
            columns |= {f'_{4 + 8 * pad}': ('u1', np.zeros(COUNT))}
            columns |= {f'field{pad}': ('f4', np.ones(COUNT))}
        yield _case(
            'cloud',
            f'PCD {form}, {"/".join(types)}, {pads} paddings',
            'cloud.PCD' if pads else 'cloud.pcd',
            dialects.pcd(columns, form),
            READ,
            _same(_stored(points, types, form == 'ascii'), noted='field0' if pads else ''),
        )
    yield from _fields(points)


_LINE_ENDS = {'LF': '\n', 'CRLF': '\r\n', 'CR': '\r'}


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
        doubles = xyz(points, TYPES[1])
        where = f'{suffix.upper()} {form}'
        for name, values, right, judge in (
            ('normals', normals, READ, _has_normals(normals)),
            (
                'normals of length 5',
                5.0 * normals,
                READ,
                _same(points, noted='normals left aside'),
            ),
            (
                'normals of length 0',
                0.0 * normals,
                READ,
                _same(points, noted='normals left aside'),
            ),
            ('one normal of length 0.5', mixed, REFUSED, None),
        ):
            columns = doubles | _named(('nx', 'ny', 'nz'), values)
            data = write(columns, form)
            yield _case('cloud', f'{where}, {name}', f'cloud.{suffix}', data, right, judge)
        columns = doubles | {name: ('u1', np.arange(COUNT)) for name in ('red', 'green', 'blue')}
        yield _case(
            'cloud',
            f'{where}, colours',
            f'cloud.{suffix}',
            write(columns, form),
            READ,
            _same(points, noted='left aside: red, green, blue'),
        )
        right, left = (
            (REFUSED, None) if suffix == 'ply' else (READ, points[np.isfinite(holes[:, 0])])
        )
        yield _case(
            'cloud',
            f'{where}, points without coordinates',
            f'cloud.{suffix}',
            write(xyz(holes, TYPES[1]), form),
            right,
            None if left is None else _same(left, noted='left out'),
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
            yield _case(
                'cloud', f'{name}, cut at byte {cut}', f'cut.{suffix}', part, EITHER, _same(stored)
            )
        for _ in range(FLIPS):
            yield _case(
                'cloud',
                f'{name}, bytes changed in transmission',
                f'flipped.{suffix}',
                _flipped(data, rng),
                ANYTHING,
            )
        ascii_form = 'ascii' in name
        more = b'0 0 0\n' if ascii_form else bytes(12)
        yield _case('cloud', f'{name}, a point too many', f'more.{suffix}', data + more, REFUSED)
    for form, count in product(PLY_FORMS, (10**12, 61, 59, -60, '6e1')):
        data = dialects.ply(xyz(points), form, count=count)
        yield _case('cloud', f'PLY {form} says {count} points', 'lying.ply', data, REFUSED)
    for form, count in product(PCD_FORMS, (10**12, 61, 59, -60, '6e1')):
        data = dialects.pcd(xyz(points), form, count=count)
        yield _case('cloud', f'PCD {form} says {count} points', 'lying.pcd', data, REFUSED)
    yield from _headers(points)


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
        yield _case('cloud', name, f'header.{suffix}', data.replace(old, new, 1), REFUSED)
    packed = dialects.pcd(xyz(points), 'binary_compressed')
    start = packed.index(b'_compressed\n') + len(b'_compressed\n')
    sizes = struct.unpack_from('<II', packed, start)
    for change in ((1, 0), (-1, 0), (0, 12), (0, 2**31), (2**31, 2**31)):
        lying = struct.pack('<II', *(a + b for a, b in zip(sizes, change, strict=True)))
        after = start + 8
        data = packed[:start] + lying + packed[after:]
        yield _case(
            'cloud', f'PCD compressed, sizes changed by {change}', 'lzf.pcd', data, REFUSED
        )


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(data)
    for place in rng.integers(0, len(data), 3):
        damaged[place] = rng.integers(256)
    return bytes(damaged)


# Tables of text


def _tables(points: np.ndarray) -> Iterator[Case]:
    columns = dict(zip('xyz', points.T, strict=True))
    suffixes = ('xyz', 'txt', 'csv', 'asc')
    delimiters = {'blank': ' ', 'tab': '\t', 'comma': ',', 'semicolon': ';', 'comma, blank': ', '}
    headers = ('', 'lower', 'upper', 'quoted', 'slashes', 'hash')
    codes = ('utf-8', 'utf-8-sig', 'utf-16')
    for k, (delimiter, header) in enumerate(product(delimiters, headers)):
        newline, code = list(_LINE_ENDS.items())[k % 3], codes[k // 2 % 3]
        text = dialects.text(columns, delimiters[delimiter], header=header, newline=newline[1])
        yield _case(
            'cloud',
            f'text, {delimiter}, header {header or "none"}, {newline[0]}, {code}',
            f'cloud.{suffixes[k % 4]}',
            text.encode(code),
            READ,
            _same(points),
        )
    counted = dialects.text(columns, before=[str(COUNT)])
    yield _case('cloud', 'PTS with its count', 'cloud.pts', counted, READ, _same(points))
    for lines in (['# scan'], ['// scan', ''], ['//X Y Z', str(COUNT)]):
        text = dialects.text(columns, before=lines)
        yield _case('cloud', f'text after {lines}', 'cloud.txt', text, READ, _same(points))
    packed = gzip.compress(counted.encode())
    yield _case('cloud', 'PTS packed by gzip', 'cloud.pts.gz', packed, READ, _same(points))
    by_name = dialects.text(
        {'id': np.arange(COUNT), **dict(reversed(columns.items()))}, header='lower'
    )
    yield _case('cloud', 'columns in another order', 'cloud.txt', by_name, READ, _same(points))


def _table_faults(points: np.ndarray, rng: np.random.Generator) -> Iterator[Case]:
    columns = dict(zip('xyz', points.T, strict=True))
    for delimiter, header in product((',', ';', ' ', '\t'), ('', 'lower')):
        text = dialects.text(columns, delimiter, header=header, comma=True)
        name = f'text with decimal commas, {delimiter!r}, header {header or "none"}'
        yield _case('cloud', name, 'comma.csv', text, REFUSED)
    two_decimals = dialects.text(columns, ',', comma=True, decimals=2)
    yield _case('cloud', 'text of decimal commas like colours', 'comma.csv', two_decimals, REFUSED)
    colours = {f'c{k}': rng.integers(0, 256, COUNT) for k in range(3)}
    aside = _same(points, noted='colours')
    for delimiter in (' ', ';', '\t'):
        text = dialects.text(columns | colours, delimiter)
        yield _case('cloud', f'unnamed colours, {delimiter!r}', 'coloured.xyz', text, READ, aside)
    floats = {name: values / 255.0 for name, values in colours.items()}
    text = dialects.text(columns | floats)
    yield _case('cloud', 'unnamed colours from 0 to 1', 'coloured.xyz', text, READ, aside)
    mixed = {
        f'n{axis}': np.where(np.arange(COUNT) % 2, one, -0.4)
        for axis, one in zip('xyz', (0, 0, 1), strict=True)
    }
    yield _case(
        'cloud',
        'unnamed columns, half of them normals',
        'mixed.xyz',
        dialects.text(columns | mixed),
        REFUSED,
    )
    whole = dialects.text(columns, ' ').encode()
    for cut in rng.integers(10, len(whole), 3 * CUTS):
        yield _case(
            'cloud',
            f'text cut at byte {cut}',
            'cut.xyz',
            whole[:cut],
            EITHER,
            _same(points, few=True),
        )
    counted = dialects.text(columns, before=[str(COUNT)]).encode()
    for cut in rng.integers(10, len(counted), CUTS):
        yield _case(
            'cloud', f'PTS cut at byte {cut}', 'cut.pts', counted[:cut], EITHER, _same(points)
        )
    for name, text in _BAD_TABLES.items():
        yield _case('cloud', f'text: {name}', 'bad.csv', text, REFUSED)
    yield Case('cloud', 'gzip of 90 MB of zeros', _gzip_bomb, read_shape, REFUSED)
    packed = gzip.compress(whole)
    yield _case('cloud', 'gzip, cut', 'cut.xyz.gz', packed[:-9], REFUSED)
    yield _case('cloud', 'gzip of nothing', 'none.xyz.gz', b'\x1f\x8b', REFUSED)


_BAD_TABLES = {
    'empty': '',
    'only a header': 'x,y,z\n',
    'two columns': '1,2\n3,4\n',
    'four columns': '1,2,3,4\n',
    'nine columns': '1,2,3,4,5,6,7,8,9\n',
    'header of two, rows of three': 'x,y\n1,2,3\n',
    'header of three, rows of four': 'x,y,z\n1,2,3,4\n',
    'a row of two': '1 2 3\n1 2\n1 2 3\n',
    'a name twice': 'x,y,z,x\n1,2,3,4\n',
    'a part of a normal': 'x,y,z,nx\n1,2,3,1\n',
    'millimetres in the header': 'x [mm],y [mm],z [mm]\n1,2,3\n',
    'a word': '1 2 3\n1 two 3\n',
    'an empty field': '1,,3\n4,5,6\n',
    'nan': '1 2 3\nnan 1 2\n',
    'infinity': '1 2 3\ninf 1 2\n',
    'overflow': '1 2 3\n1 2 1e999\n',
    'too far': '1 2 3\n1 2 1e12\n',
    'binary': '\0\1\2\3',
    'a count too large': '4\n1 2 3\n4 5 6\n7 8 9\n',
    'a count too small': '2\n1 2 3\n4 5 6\n7 8 9\n',
}


# Meshes


def _solid(rng: np.random.Generator) -> tuple[np.ndarray, list[list[int]]]:
    """Three boxes, 1 m wide and 2 m apart, moved by whole millimetres."""
    shift = rng.integers(-500, 500, 3) * 1e-3
    boxes = [dialects.box(shift + [2.0 * k, 0.0, 0.0], [1.0, 1.0, 1.0]) for k in range(3)]
    vertices = np.concatenate([one for one, _ in boxes]).round(DECIMALS)
    sides = [[c + 8 * k for c in side] for k, (_, faces) in enumerate(boxes) for side in faces]
    return vertices, sides


def _same_mesh(corners: np.ndarray, few: bool = False) -> Callable[[Mesh], str]:
    """Judge a mesh: these triangles (F, 3, 3) in their order, or with `few` the first of them."""

    def judge(mesh: Mesh) -> str:
        expected = corners[: len(mesh.faces)] if few else corners
        read = mesh.vertices[mesh.faces]
        if read.shape != expected.shape:
            return f'{len(read)} triangles in place of {len(corners)}'
        off = np.abs(read - expected).max(initial=0.0)
        return f'corners off by {off:.3g}' if off > 0.0 else ''

    return judge


def _written_meshes(
    rng: np.random.Generator,
) -> Iterator[tuple[str, str, bytes, np.ndarray, bool]]:
    """(name, suffix, content, its triangles, whether the file says how many)."""
    vertices, sides = _solid(rng)
    triangles = dialects.triangles(sides)
    corners = vertices[np.array(triangles)]
    single = corners.astype(np.float32).astype(np.float64)
    yield 'STL', 'stl', dialects.stl(corners), single, True
    yield 'STL, head solid', 'STL', dialects.stl(corners, b'solid of steel'), single, True
    yield 'STL ascii', 'stl', dialects.ascii_stl(corners).encode(), corners, True
    for form, faces in product(PLY_FORMS, (sides, triangles)):
        data = dialects.ply(xyz(vertices, TYPES[1]), form, faces=faces)
        yield f'PLY {form}, {len(faces[0])} corners', 'ply', data, corners, True
    for relative, slash, faces in product((False, True), ('', '/1', '//1'), (sides, triangles)):
        if relative:  # each box followed by its own faces
            parts = ((vertices[range(k, k + 8)], _part(faces, k)) for k in (0, 8, 16))
            text = ''.join(dialects.obj(*part, relative=True, slash=slash) for part in parts)
        else:
            text = dialects.obj(vertices, faces, slash=slash)
        name = f'OBJ, {len(faces[0])} corners, relative {relative}, slash {slash or "none"}'
        yield name, 'obj', text.encode(), corners, False


def _part(faces: list[list[int]], first: int) -> list[list[int]]:
    return [[c - first for c in face] for face in faces if first <= face[0] < first + 8]


def _meshes(rng: np.random.Generator) -> Iterator[Case]:
    for name, suffix, data, corners, _ in _written_meshes(rng):
        yield _case('mesh', name, f'part.{suffix}', data, READ, _same_mesh(corners))
        if suffix == 'obj':
            data = data.replace(b'\n', b'\r\n')
            yield _case('mesh', f'{name}, CRLF', 'part.obj', data, READ, _same_mesh(corners))


def _mesh_faults(rng: np.random.Generator) -> Iterator[Case]:
    for name, suffix, data, corners, counted in _written_meshes(rng):
        for cut in rng.integers(0, len(data), 2):
            judge = _same_mesh(corners, few=not counted)
            yield _case(
                'mesh', f'{name}, cut at byte {cut}', f'cut.{suffix}', data[:cut], EITHER, judge
            )
        flipped = _flipped(data, rng)
        yield _case('mesh', f'{name}, bytes changed', f'flipped.{suffix}', flipped, ANYTHING)
    vertices, sides = dialects.box([0, 0, 0], [1, 1, 1])
    corners = vertices[np.array(dialects.triangles(sides))]
    for count in (11, 13, 2**32 - 1):
        data = dialects.stl(corners, count=count)
        yield _case('mesh', f'STL says {count} triangles', 'lying.stl', data, REFUSED)
    whole = dialects.obj(vertices, sides)
    for name, text in {
        'a missing vertex': whole + 'f 1 2 9\n',
        'vertex 0': whole + 'f 0 1 2\n',
        'a vertex before the first': whole + 'f -9 -1 -2\n',
        'a face of two': whole + 'f 1 2\n',
        'a vertex of two': 'v 1 2\n' + whole,
        'a decimal comma': whole.replace('0.0000', '0,0000', 1),
        'a vertex that is not finite': whole.replace('0.0000', 'nan', 1),
        'no faces': dialects.obj(vertices, []),
        'fewer faces than its comments say': f'# Faces: 7\n{whole}',
        'a weight': 'v 0 0 0 2\nv 1 0 0 2\nv 0 1 0 2\nf 1 2 3\n',
    }.items():
        yield _case('mesh', f'OBJ: {name}', 'bad.obj', text, REFUSED)
    for name, faces in {'a missing vertex': [[0, 1, 8]], 'a face of two': [[0, 1]]}.items():
        for form in PLY_FORMS:
            data = dialects.ply(xyz(vertices), form, faces=faces)
            yield _case('mesh', f'PLY {form}: {name}', 'bad.ply', data, REFUSED)


# Our own maps


def _own_maps(points: np.ndarray, rng: np.random.Generator) -> Iterator[Case]:
    normals, planarity = np.tile([0, 0, 1.0], (COUNT, 1)), np.ones(COUNT)

    def written(folder: Path) -> Path:
        path = folder / 'map.npz'
        PriorMap(points, normals, planarity).save(path)
        return path

    yield Case('map', 'our own', written, load_map, READ, _same(points))
    for share in rng.uniform(0.0, 1.0, 2 * CUTS):
        yield Case(
            'map', f'our own, cut at {100 * share:.1f} %', _cut(written, share), load_map, REFUSED
        )
    for number in range(2 * FLIPS):
        changed = _changed(written, seed=int(rng.integers(2**31)))
        yield Case(
            'map', f'our own, bytes changed ({number})', changed, load_map, EITHER, _same(points)
        )
    for name, members in _archives(points).items():
        yield Case('map', f'archive: {name}', _archived(members), load_map, REFUSED)
    yield Case('map', 'archive: 300 MB of zeros', _zip_bomb, load_map, REFUSED)


def _cut(written: Callable[[Path], Path], share: float) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = written(folder)
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        return path

    return write


def _changed(written: Callable[[Path], Path], seed: int) -> Callable[[Path], Path]:
    """Change bytes within the arrays, which the archive has check sums of."""

    def write(folder: Path) -> Path:
        path = written(folder)
        data = bytearray(path.read_bytes())
        place = np.random.default_rng(seed).integers(200, len(data) - 1000)
        data[place] ^= 255
        path.write_bytes(data)
        return path

    return write


def _archives(points: np.ndarray) -> dict[str, dict[str, bytes]]:
    """Members of archives that lie about themselves."""
    about = json.dumps({'sigma': 0.001, 'spacing': 0.1})
    good = {
        'format.npy': _words(NPZ_FORMAT),
        'about.npy': _words(about),
        'points.npy': array_file((COUNT, 3), points.tobytes()),
        'normals.npy': array_file((COUNT, 3), np.tile([0, 0, 1.0], (COUNT, 1)).tobytes()),
        'planarity.npy': array_file((COUNT,), np.ones(COUNT).tobytes()),
    }
    changed = {
        '1e12 points': {'points.npy': array_file((10**12, 3), points.tobytes())},
        'a size that wraps': {'points.npy': array_file((2**61, 3), points.tobytes())},
        'a negative size': {'points.npy': array_file((-1, 3), points.tobytes())},
        'one row too few': {'points.npy': array_file((COUNT, 3), points[1:].tobytes())},
        'objects': {'points.npy': array_file((COUNT,), b'cos\nsystem\n', '|O')},
        'no numbers': {'points.npy': array_file((COUNT, 3), bytes(4 * 3 * COUNT), '<U1')},
        'not finite': {
            'points.npy': array_file((COUNT, 3), np.full((COUNT, 3), np.inf).tobytes())
        },
        'no unit normals': {'normals.npy': array_file((COUNT, 3), points.tobytes())},
        'planarity of 2': {'planarity.npy': array_file((COUNT,), np.full(COUNT, 2.0).tobytes())},
        'another format': {'format.npy': _words('a map of somebody else')},
        'sigma of nan': {'about.npy': _words('{"sigma": NaN, "spacing": 0.1}')},
        'an unknown word': {'about.npy': _words('{"sigma": 0.1, "spacing": 0.1, "colour": 1}')},
        'brackets 100,000 deep': {'about.npy': _words('[' * 100_000)},
    }
    return {name: good | change for name, change in changed.items()}


def _gzip_bomb(folder: Path) -> Path:
    path = folder / 'bomb.xyz.gz'
    with gzip.open(path, 'wb') as packed:
        for _ in range(150):
            packed.write(b'0 0 0\n' * 100_000)
    return path


def _zip_bomb(folder: Path) -> Path:
    path = folder / 'bomb.npz'
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        with archive.open('points.npy', 'w') as member:
            for _ in range(300):
                member.write(bytes(1_000_000))
    return path


def _archived(members: dict[str, bytes]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / 'lying.npz'
        with zipfile.ZipFile(path, 'w') as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        return path

    return write


def _words(text: str) -> bytes:
    return array_file((), text.encode('utf-32-le'), f'<U{len(text)}')


def array_file(shape: tuple[int, ...], data: bytes, kind: str = '<f8') -> bytes:
    """Write an array of NumPy, whose header may promise what the data do not hold."""
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}".encode()
    header = header.ljust(117) + b'\n'
    return b'\x93NUMPY\x01\x00' + struct.pack('<H', len(header)) + header + data
