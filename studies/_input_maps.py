"""Our own maps: whole, damaged, and archives that lie about themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import json
from pathlib import Path
import struct
import zipfile

from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import NPZ_FORMAT, PriorMap
import numpy as np
from studies._input_case import Case, EITHER, READ, REFUSED
from studies._input_files import cloud_points, COUNT, CUTS, FLIPS, same


def map_cases(seed: int) -> Iterator[Case]:
    """All maps of our own."""
    rng = np.random.default_rng(seed)
    yield from _own_maps(cloud_points(rng), rng)


def _own_maps(points: np.ndarray, rng: np.random.Generator) -> Iterator[Case]:
    normals, planarity = np.tile([0, 0, 1.0], (COUNT, 1)), np.ones(COUNT)

    def written(folder: Path) -> Path:
        path = folder / 'map.npz'
        PriorMap(points, normals, planarity).save(path)
        return path

    yield Case('map', 'our own', written, load_map, READ, same(points))
    for share in rng.uniform(0.0, 1.0, 2 * CUTS):
        yield Case(
            'map', f'our own, cut at {100 * share:.1f} %', _cut(written, share), load_map, REFUSED
        )
    for number in range(2 * FLIPS):
        changed = _changed(written, seed=int(rng.integers(2**31)))
        yield Case(
            'map', f'our own, bytes changed ({number})', changed, load_map, EITHER, same(points)
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
