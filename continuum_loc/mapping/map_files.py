"""Prior maps from files: our own, clouds, tables of text, and meshes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from continuum_loc.errors import MapError
from continuum_loc.formats.content import bytes_of
from continuum_loc.formats.reading import read_shape
from continuum_loc.formats.shapes import Cloud
from continuum_loc.mapping.build import map_from_cloud, sample_mesh
from continuum_loc.mapping.prior_map import NPZ_FORMAT, PriorMap
from continuum_loc.npz_files import NotAnArchive, read_arrays
import numpy as np

MESH_POINTS = 300_000
_ARRAYS = ('points', 'normals', 'planarity')
_ABOUT: dict[str, tuple[type, ...]] = {
    'sigma': (float, int),
    'spacing': (float, int),
    'oriented': (bool,),
    'source': (str,),
    'seed': (int, type(None)),
    'notes': (list,),
}


def load_map(
    path: str | Path,
    *,
    sigma: float | None = None,
    spacing: float | None = None,
    viewpoint: np.ndarray | None = None,
    seed: int = 0,
    scale: float = 1.0,
) -> PriorMap:
    """
    Load a prior map from a file.

    `.npz`, a cloud (`.ply`, `.pcd`, `.xyz`, `.txt`, `.asc`, `.csv`, `.pts`) or a mesh (`.stl`,
    `.obj`, `.ply` with faces); all but `.npz` also with `.gz` after it.

    sigma: standard deviation of a point [m]; by default what the file states, else 0.1 mm, the
    paper's scanner.
    spacing: of the points sampled from a mesh [m] (default: about 300,000 points); seed: of that
    sampling.
    viewpoint: (3,) a place [m] that the surface is seen from, toward which the normals of a cloud
        that has none are turned. Without it they keep either sign and the map is not `oriented`.
    scale: what the file's lengths are multiplied by to be metres: 0.001 for millimetres. A stated
        sigma of the map is a length too.
    What was left out of the map, or aside, is in its `notes`. Raises MapError naming the file, the
    place and what is valid.
    """
    path = Path(path)
    if not (np.isfinite(scale) and scale > 0.0):
        raise MapError(f'{path}: scale must be > 0, got {scale}')
    if path.suffix.lower() == '.npz':
        return _own(path, scale, sigma)
    shape = read_shape(path)
    stated = {} if sigma is None else {'sigma': sigma}
    where = {'source': str(path), 'notes': _scaled(scale, shape.notes)}
    if isinstance(shape, Cloud):
        return map_from_cloud(
            shape.points * scale,
            shape.normals,
            shape.planarity,
            viewpoint=viewpoint,
            **where,
            **stated,
        )
    density = {'count': MESH_POINTS} if spacing is None else {'spacing': spacing}
    return sample_mesh(
        shape.vertices * scale, shape.faces, seed=seed, **density, **where, **stated
    )


def _scaled(scale: float, notes: tuple[str, ...]) -> tuple[str, ...]:
    return notes if scale == 1.0 else (*notes, f'lengths multiplied by {scale:g}')


# Own format


def _own(path: Path, scale: float, sigma: float | None) -> PriorMap:
    if not path.is_file():
        bytes_of(path)  # says what it is instead
    try:
        arrays = read_arrays(path)
        if str(arrays.get('format')) != NPZ_FORMAT:
            raise MapError(f"{path}: format '{arrays.get('format')}', expected '{NPZ_FORMAT}'")
        about = _about(str(arrays['about']))
        if scale != 1.0:
            about['notes'] = _scaled(scale, about['notes'])
            about |= {name: scale * about[name] for name in ('sigma', 'spacing')}
            arrays['points'] = arrays['points'] * scale
        about |= {'source': str(path)} | ({} if sigma is None else {'sigma': sigma})
        return PriorMap(*(_numbers(arrays, name) for name in _ARRAYS), **about)
    except (NotAnArchive, KeyError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, MapError):
            raise
        raise MapError(f'{path}: not a map written by PriorMap.save ({error})') from None


def _about(text: str) -> dict[str, Any]:
    """Check what is said about a map: known names, of their types."""
    about = {'sigma': 1e-4, 'spacing': 0.0, 'notes': []} | json.loads(text)
    for name, value in about.items():
        if name not in _ABOUT or type(value) not in _ABOUT[name]:
            raise ValueError(f'{name}: {value!r}')
    if not all(isinstance(note, str) for note in about['notes']):
        raise ValueError(f'notes: {about["notes"]!r}')
    return about | {'notes': tuple(about['notes'])}


def _numbers(arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    if arrays[name].dtype.kind not in 'fiu':
        raise ValueError(f'{name} are of type {arrays[name].dtype}')
    return arrays[name]
