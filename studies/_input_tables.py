"""Clouds as tables of text: dialects that are to be read, and faults that are to be told."""

from __future__ import annotations

from collections.abc import Iterator
import gzip
from itertools import product
from pathlib import Path

from continuum_loc.formats.reading import read_shape
import numpy as np
from studies._input_case import Case, EITHER, READ, REFUSED
from studies._input_files import cloud_points, COUNT, CUTS, file_case, LINE_ENDS, same
from studies.support import dialects


def table_cases(seed: int) -> Iterator[Case]:
    """All tables of text."""
    rng = np.random.default_rng(seed)
    points = cloud_points(rng)
    yield from _tables(points)
    yield from _table_faults(points, rng)


def _tables(points: np.ndarray) -> Iterator[Case]:
    columns = dict(zip('xyz', points.T, strict=True))
    suffixes = ('xyz', 'txt', 'csv', 'asc')
    delimiters = {'blank': ' ', 'tab': '\t', 'comma': ',', 'semicolon': ';', 'comma, blank': ', '}
    headers = ('', 'lower', 'upper', 'quoted', 'slashes', 'hash')
    codes = ('utf-8', 'utf-8-sig', 'utf-16')
    for k, (delimiter, header) in enumerate(product(delimiters, headers)):
        newline, code = list(LINE_ENDS.items())[k % 3], codes[k // 2 % 3]
        text = dialects.text(columns, delimiters[delimiter], header=header, newline=newline[1])
        yield file_case(
            'cloud',
            f'text, {delimiter}, header {header or "none"}, {newline[0]}, {code}',
            f'cloud.{suffixes[k % 4]}',
            text.encode(code),
            READ,
            same(points),
        )
    counted = dialects.text(columns, before=[str(COUNT)])
    yield file_case('cloud', 'PTS with its count', 'cloud.pts', counted, READ, same(points))
    for lines in (['# scan'], ['// scan', ''], ['//X Y Z', str(COUNT)]):
        text = dialects.text(columns, before=lines)
        yield file_case('cloud', f'text after {lines}', 'cloud.txt', text, READ, same(points))
    packed = gzip.compress(counted.encode())
    yield file_case('cloud', 'PTS packed by gzip', 'cloud.pts.gz', packed, READ, same(points))
    by_name = dialects.text(
        {'id': np.arange(COUNT), **dict(reversed(columns.items()))}, header='lower'
    )
    yield file_case('cloud', 'columns in another order', 'cloud.txt', by_name, READ, same(points))


def _table_faults(points: np.ndarray, rng: np.random.Generator) -> Iterator[Case]:
    columns = dict(zip('xyz', points.T, strict=True))
    for delimiter, header in product((',', ';', ' ', '\t'), ('', 'lower')):
        text = dialects.text(columns, delimiter, header=header, comma=True)
        name = f'text with decimal commas, {delimiter!r}, header {header or "none"}'
        yield file_case('cloud', name, 'comma.csv', text, REFUSED)
    two_decimals = dialects.text(columns, ',', comma=True, decimals=2)
    yield file_case(
        'cloud', 'text of decimal commas like colours', 'comma.csv', two_decimals, REFUSED
    )
    colours = {f'c{k}': rng.integers(0, 256, COUNT) for k in range(3)}
    aside = same(points, noted='colours')
    for delimiter in (' ', ';', '\t'):
        text = dialects.text(columns | colours, delimiter)
        yield file_case(
            'cloud', f'unnamed colours, {delimiter!r}', 'coloured.xyz', text, READ, aside
        )
    floats = {name: values / 255.0 for name, values in colours.items()}
    text = dialects.text(columns | floats)
    yield file_case('cloud', 'unnamed colours from 0 to 1', 'coloured.xyz', text, READ, aside)
    mixed = {
        f'n{axis}': np.where(np.arange(COUNT) % 2, one, -0.4)
        for axis, one in zip('xyz', (0, 0, 1), strict=True)
    }
    yield file_case(
        'cloud',
        'unnamed columns, half of them normals',
        'mixed.xyz',
        dialects.text(columns | mixed),
        REFUSED,
    )
    whole = dialects.text(columns, ' ').encode()
    for cut in rng.integers(10, len(whole), 3 * CUTS):
        yield file_case(
            'cloud',
            f'text cut at byte {cut}',
            'cut.xyz',
            whole[:cut],
            EITHER,
            same(points, few=True),
        )
    counted = dialects.text(columns, before=[str(COUNT)]).encode()
    for cut in rng.integers(10, len(counted), CUTS):
        yield file_case(
            'cloud', f'PTS cut at byte {cut}', 'cut.pts', counted[:cut], EITHER, same(points)
        )
    for name, text in _BAD_TABLES.items():
        yield file_case('cloud', f'text: {name}', 'bad.csv', text, REFUSED)
    yield Case('cloud', 'gzip of 90 MB of zeros', _gzip_bomb, read_shape, REFUSED)
    packed = gzip.compress(whole)
    yield file_case('cloud', 'gzip, cut', 'cut.xyz.gz', packed[:-9], REFUSED)
    yield file_case('cloud', 'gzip of nothing', 'none.xyz.gz', b'\x1f\x8b', REFUSED)


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


def _gzip_bomb(folder: Path) -> Path:
    path = folder / 'bomb.xyz.gz'
    with gzip.open(path, 'wb') as packed:
        for _ in range(150):
            packed.write(b'0 0 0\n' * 100_000)
    return path
