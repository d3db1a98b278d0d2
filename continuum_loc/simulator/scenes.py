"""
Scenes by name or file.

`load_scene("S0")` ... `"S9"` are the engine of the paper (as built, with added objects, with
missing features, with both), `"R0"` ... `"R4"` the box with none to four objects; anything else is
the path of your own mesh.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from continuum_loc.errors import SceneError
from continuum_loc.simulator.scene import Scene

ENGINE_SCENES = tuple(f'S{i}' for i in range(10))
HOLD_OUT_SCENES = ('H1', 'H2', 'H3')  # the engine again, to tune a detector on
BOX_SCENES = tuple(f'R{i}' for i in range(5))
SCENE_NAMES = ENGINE_SCENES + BOX_SCENES
MESH_SUFFIXES = ('.stl', '.obj', '.ply')


def load_scene(name_or_path: str | Path) -> Scene:
    """
    Load a scene by name (`S0`-`S9`, `H1`-`H3`, `R0`-`R4`) or from a mesh file in metres.

    Raises SceneError for an unknown name, an unreadable file, or a mesh that is not fit for use.
    """
    name = str(name_or_path)
    if name in SCENE_NAMES + HOLD_OUT_SCENES:
        return _built(name)
    if Path(name).suffix.lower() in MESH_SUFFIXES:
        from continuum_loc.simulator.mesh_import import import_mesh

        return import_mesh(Path(name))
    raise SceneError(
        f"no scene '{name}': give one of {', '.join(SCENE_NAMES)}, or the path of a "
        f'{", ".join(MESH_SUFFIXES)} file'
    )


@lru_cache(maxsize=4)
def _built(name: str) -> Scene:
    from continuum_loc.simulator import box, engine_variants
    from continuum_loc.simulator.scene_cache import cached_scene

    if name in BOX_SCENES:
        return box.box_scene(name)
    return cached_scene(
        name, engine_variants.__name__, lambda: engine_variants.engine_variant(name)
    )
