"""
Built scenes on disk, so that a scene which takes seconds to make is made once.

An entry's name holds a digest of everything that it was made from, the generator's code and what
that imports among it: a changed generator never meets an old entry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
import hashlib
import os
from pathlib import Path

from continuum_loc.caches import cache_folder
from continuum_loc.closure import digest_of_code
from continuum_loc.npz_files import read_arrays
from continuum_loc.simulator.scene import Anomaly, Scene
import numpy as np

KIND = 'scenes'


def cached_scene(
    name: str, generator: str, build: Callable[[], Scene], made_from: Iterable[Path] = ()
) -> Scene:
    """
    Take the scene `name` from the cache, or build it and put it there.

    generator: name of the module that builds it. made_from: files whose content decides it too.
    """
    digest = hashlib.sha256(digest_of_code(generator, __name__, presets=False).encode())
    for path in made_from:
        digest.update(path.read_bytes())
    entry = cache_folder(KIND) / f'{name}-{digest.hexdigest()[:16]}.npz'
    try:
        return _read(entry)
    except (OSError, KeyError, ValueError):
        scene = build()  # absent, or cut short by a crash
    _write(scene, entry)
    return scene


def _write(scene: Scene, entry: Path) -> None:
    arrays = {
        'name': np.array(scene.name),
        'vertices': scene.vertices,
        'faces': scene.faces,
        'face_object': scene.face_object,
        'objects': np.array(scene.objects),
        'reflectance': scene.reflectance,
        'anomaly_names': np.array([a.name for a in scene.anomalies], dtype=str),
        'anomaly_kinds': np.array([a.kind for a in scene.anomalies], dtype=str),
        **_pack('hulls', scene.hulls),
        **_pack('anomaly_vertices', [a.vertices for a in scene.anomalies]),
        **_pack('anomaly_faces', [a.faces for a in scene.anomalies], np.int32),
    }
    with suppress(OSError):
        # A home that is full or read-only costs time on every start, nothing else.
        entry.parent.mkdir(parents=True, exist_ok=True)
        partial = entry.with_name(f'{entry.stem}.{os.getpid()}.tmp')
        with partial.open('wb') as file:
            np.savez(file, **arrays)
        partial.replace(entry)  # atomic: another process sees all of it or nothing


def _read(entry: Path) -> Scene:
    data = read_arrays(entry)
    anomalies = zip(
        data['anomaly_names'],
        data['anomaly_kinds'],
        _unpack(data, 'anomaly_vertices'),
        _unpack(data, 'anomaly_faces'),
        strict=True,
    )
    return Scene(
        str(data['name']),
        data['vertices'],
        data['faces'],
        data['face_object'],
        tuple(map(str, data['objects'])),
        data['reflectance'],
        tuple(_unpack(data, 'hulls')),
        tuple(
            Anomaly(str(name), str(kind), vertices, faces)
            for name, kind, vertices, faces in anomalies
        ),
    )


def _pack(
    name: str, arrays: Iterable[np.ndarray], dtype: type = np.float64
) -> dict[str, np.ndarray]:
    """Arrays (n_i, 3) as one array and the places where it splits."""
    arrays = list(arrays)
    stacked = np.concatenate(arrays, dtype=dtype) if arrays else np.empty((0, 3), dtype=dtype)
    return {
        name: stacked,
        f'{name}_ends': np.cumsum([len(array) for array in arrays], dtype=np.int64),
    }


def _unpack(data: dict[str, np.ndarray], name: str) -> list[np.ndarray]:
    ends = data[f'{name}_ends']
    return np.split(data[name], ends[:-1]) if len(ends) else []
