"""Prior maps of scenes, sampled once and kept on disk."""

from __future__ import annotations

from contextlib import suppress
import hashlib
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from continuum_loc.caches import cache_folder, scratch_folder
from continuum_loc.closure import digest_of_code
from continuum_loc.errors import MapError

if TYPE_CHECKING:
    from continuum_loc.mapping.prior_map import PriorMap
    from continuum_loc.simulator.scene import Scene

MAP_POINTS = 300_000
SAMPLER = 'continuum_loc.mapping.build'

_elsewhere: dict[str, Path] = {}  # maps of this process that could not be kept, by name


def scene_map(scene_name: str | Path, points: int = MAP_POINTS, seed: int = 0) -> PriorMap:
    """Return the prior map of a scene, sampled from its mesh once and kept on disk."""
    from continuum_loc.mapping.map_files import load_map

    return load_map(scene_map_file(scene_name, points, seed))


def scene_map_file(scene_name: str | Path, points: int = MAP_POINTS, seed: int = 0) -> Path:
    """
    Name the file of `scene_map`, sampled where it is not there yet.

    Its name holds a digest of the mesh and of the code that samples it, so that neither a changed
    scene nor changed code meets an old map.
    """
    from continuum_loc.simulator.scenes import load_scene

    scene = load_scene(scene_name)
    name = f'{Path(scene_name).stem}-{points}-{seed}-{_digest(scene)}.npz'
    path = _elsewhere.get(name, map_cache() / name)
    if not path.is_file():
        path = _sampled(scene, name, source=str(scene_name), count=points, seed=seed)
    return path


def map_cache() -> Path:
    """`$XDG_CACHE_HOME/continuum_loc/maps`, by default under `~/.cache`."""
    return cache_folder('maps')


def _digest(scene: Scene) -> str:
    digest = hashlib.sha256(digest_of_code(SAMPLER, presets=False).encode())
    digest.update(scene.vertices.tobytes() + scene.faces.tobytes())
    return digest.hexdigest()[:16]


def _sampled(scene: Scene, name: str, **how: Any) -> Path:
    """Sample a map into the cache; where that cannot be written, into a folder of this process."""
    from continuum_loc.mapping.build import sample_mesh

    prior = sample_mesh(scene.vertices, scene.faces, **how)
    try:
        return _save(prior, map_cache() / name)
    except (OSError, MapError):  # a home that is full or read-only
        _elsewhere[name] = _save(prior, scratch_folder() / name)
        return _elsewhere[name]


def _save(prior: PriorMap, path: Path) -> Path:
    partial = path.with_name(f'{path.stem}.{os.getpid()}.npz')
    try:
        prior.save(partial)
        partial.replace(path)  # atomic: another process sees all of it or nothing
    except OSError:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise
    return path
