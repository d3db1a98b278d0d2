"""How far contact pieces stand out of the surface that sensors see, and what cutting costs."""

from __future__ import annotations

import time
from typing import Any

from continuum_loc.simulator import convex, cutting
from continuum_loc.simulator.raycast import RayCaster
from continuum_loc.simulator.scene import Scene
from continuum_loc.simulator.scenes import load_scene
from continuum_loc.simulator.solids import mesh_of
from manifold3d import Manifold
import numpy as np

_DIVISIONS = 6  # of each edge of a hull's faces: 28 points on a face
_QUICK_TILES = 6
# From the axis [m]: farther out are the casing's rub strips and ports, which its pieces fill.
_CASING = 1.46
# Single precision of the rays, metres from the origin [m].
ROUNDING = 1e-5


def contact_pieces(quick: bool) -> list[dict[str, Any]]:
    """
    Rows: the engine's own contact pieces, and those cut from it as if a user had brought it.

    quick: only some tiles of it are cut.
    """
    engine = load_scene('S0')
    allowed = convex.tolerance(engine.vertices)
    start = time.process_time()
    tiles = cutting.tiles(engine.vertices, engine.faces)
    tiles = tiles[:: len(tiles) // _QUICK_TILES] if quick else tiles
    cut = [piece for tile in tiles for piece in cutting.pieces(*tile, allowed)]
    seconds = time.process_time() - start
    return [
        _row('S0, its own pieces short of the casing', engine, engine.hulls, radius=_CASING),
        _row('S0, its own pieces', engine, engine.hulls),
        _row('S0, cut as one mesh', engine, cut, allowed, seconds),
    ]


def _row(
    name: str,
    scene: Scene,
    pieces: Any,
    allowed: float | None = None,
    seconds: float | None = None,
    radius: float = np.inf,
) -> dict[str, Any]:
    out = standing_out(scene, pieces, radius)
    return {
        'mesh': name,
        'faces': len(scene.faces),
        'pieces': len(pieces),
        'tolerance [mm]': allowed and 1e3 * allowed,
        'stands out, median [mm]': 1e3 * np.median(out),
        'stands out, 99 % [mm]': 1e3 * np.percentile(out, 99.0),
        'stands out, greatest [mm]': 1e3 * out.max(),
        'pieces beyond tolerance': allowed and int((out > allowed + ROUNDING).sum()),
        'processor time [s]': seconds,
    }


def standing_out(scene: Scene, pieces: Any, radius: float = np.inf) -> np.ndarray:
    """
    (P,) how far the hull of each piece reaches out of the scene's matter [m], 0 for not.

    Only what is nearer than `radius` to the map's x axis counts.
    """
    caster = RayCaster(scene)
    found = np.zeros(len(pieces))
    for i, piece in enumerate(pieces):
        vertices, faces = mesh_of(Manifold.hull_points(np.array(piece)))
        points = np.einsum('bk,fkx->fbx', _grid(_DIVISIONS), vertices[faces]).reshape(-1, 3)
        counted = points[np.hypot(points[:, 1], points[:, 2]) < radius]
        if len(counted):
            found[i] = max(0.0, caster.clearance(counted).max())
    return found


def _grid(n: int) -> np.ndarray:
    """Barycentric coordinates (B, 3) of points spread over a triangle, its corners included."""
    return np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
