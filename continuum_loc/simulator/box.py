"""
Scenes R0-R4: the box of 70 x 70 x 60 cm in which the soft arm hangs, with none to four objects.

The floor is z = 0, the arm comes through a hole in the middle of the ceiling. Objects stand round
its working space.
"""

from __future__ import annotations

from collections.abc import Callable

from continuum_loc.simulator.scene import Anomaly, Scene, scene_of_solid
from continuum_loc.simulator.solids import box, loft, mesh_of, Part, unite, vertices_of
from manifold3d import CrossSection, Manifold
import numpy as np

WIDTH, DEPTH, HEIGHT = 0.70, 0.70, 0.60
_WALL = 0.02
_HOLE = 0.12  # side of the square opening for the arm [m]
_SUNK = 0.001  # objects stand this deep in the floor, so that the union is one piece [m]


def box_scene(name: str) -> Scene:
    """
    Scene R<n>: the box with the first n of mustard bottle, cup, cracker box and wet-floor sign.

    Its anomalies are its objects, as `added` to the empty box R0.
    """
    objects = [make() for make in _OBJECTS[: int(name[1:])]]
    parts = [_shell(), *objects]
    solid, owners = unite(parts)
    anomalies = tuple(
        Anomaly(part.name, 'added', *mesh_of(part.solid - parts[0].solid)) for part in objects
    )
    return scene_of_solid(name, solid, owners, parts, anomalies)


def _shell() -> Part:
    outer = box((WIDTH + 2 * _WALL, DEPTH + 2 * _WALL, HEIGHT + 2 * _WALL)).translate(
        (0.0, 0.0, HEIGHT / 2)
    )
    inner = box((WIDTH, DEPTH, HEIGHT)).translate((0.0, 0.0, HEIGHT / 2))
    hole = box((_HOLE, _HOLE, 4 * _WALL)).translate((0.0, 0.0, HEIGHT))
    return Part('box', outer - inner - hole, tuple(vertices_of(slab) for slab in _slabs()), 0.7)


def _slabs() -> list[Manifold]:
    """Floor, walls, and the ceiling round its hole, as cuboids."""
    thick = 0.05  # thicker than the shell: contact must not tunnel through
    flat = (WIDTH + 2 * thick, DEPTH + 2 * thick)
    rim = (WIDTH - _HOLE) / 2 + thick
    floor = box((*flat, thick)).translate((0.0, 0.0, -thick / 2))
    wall = box((thick, flat[1], HEIGHT + 2 * thick)).translate(
        ((WIDTH + thick) / 2, 0.0, HEIGHT / 2)
    )
    ceiling = box((rim, flat[1], thick)).translate(((_HOLE + rim) / 2, 0.0, HEIGHT + thick / 2))
    return [
        floor,
        *(slab.rotate((0.0, 0.0, 90.0 * k)) for slab in (wall, ceiling) for k in range(4)),
    ]


def _mustard() -> Part:
    """Make a squeeze bottle of 6 x 10 x 19 cm: oval, narrow at the shoulder, with a round cap."""
    heights = np.array([0.0, 0.008, 0.05, 0.10, 0.125, 0.145, 0.155])
    half_width = np.array([0.042, 0.047, 0.048, 0.047, 0.042, 0.026, 0.016])
    half_depth = np.array([0.024, 0.029, 0.030, 0.029, 0.026, 0.020, 0.016])
    body = loft(_ovals(heights, half_width, half_depth))
    cap = Manifold.cylinder(0.037, 0.016, 0.006, 32).translate((0.0, 0.0, 0.153))
    return _standing('mustard_bottle', [body, cap], (0.25, 0.18), turn_deg=35.0, reflectance=0.8)


def _cup() -> Part:
    """Make a cup, 8 cm across and high, open at the top, with a handle."""
    bore = Manifold.cylinder(0.08, 0.034, 0.036, 48).translate((0.0, 0.0, 0.005))
    bowl = Manifold.cylinder(0.08, 0.036, 0.040, 48) - bore
    ring = CrossSection.circle(0.006, 16).translate((0.024, 0.0)).revolve(32)
    handle = ring.rotate((90.0, 0.0, 0.0)).translate((0.044, 0.0, 0.04)) - Manifold.cylinder(
        0.08, 0.035, 0.037, 48
    )
    filled = vertices_of(bowl)
    hulls = (filled, vertices_of(handle))
    return _place(Part('cup', bowl + handle, hulls, 0.85), (-0.24, 0.20), turn_deg=-60.0)


def _cracker_box() -> Part:
    """Make a carton, 6 x 16 x 21 cm."""
    carton = box((0.06, 0.16, 0.21)).translate((0.0, 0.0, 0.105))
    return _standing('cracker_box', [carton], (0.25, -0.19), turn_deg=-30.0, reflectance=0.6)


def _sign() -> Part:
    """Make a folded wet-floor sign, 40 cm high: two boards lean on one another below a grip."""
    height, spread, lean = 0.38, 0.20, np.degrees(np.arctan2(0.095, 0.38))
    board = box((0.006, 0.20, height / np.cos(np.radians(lean)))).rotate((0.0, lean, 0.0))
    left = board.translate((-spread / 4, 0.0, height / 2))
    grip = box((0.024, 0.07, 0.03)).translate((0.0, 0.0, height + 0.005))
    pieces = [left, left.mirror((1.0, 0.0, 0.0)), grip]
    return _standing('wet_floor_sign', pieces, (-0.205, -0.19), turn_deg=40.0, reflectance=0.75)


_OBJECTS: tuple[Callable[[], Part], ...] = (_mustard, _cup, _cracker_box, _sign)


def _standing(
    name: str, pieces: list[Manifold], xy: tuple[float, float], turn_deg: float, reflectance: float
) -> Part:
    """Make a part of convex pieces, standing on the floor at `xy`."""
    hulls = tuple(vertices_of(piece) for piece in pieces)
    return _place(Part(name, sum(pieces[1:], pieces[0]), hulls, reflectance), xy, turn_deg)


def _place(part: Part, xy: tuple[float, float], turn_deg: float) -> Part:
    angle = np.radians(turn_deg)
    rotation = np.array(
        [
            [np.cos(angle), -np.sin(angle), 0.0],
            [np.sin(angle), np.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    shift = np.array([*xy, -_SUNK])
    solid = part.solid.transform(np.column_stack([rotation, shift]))
    return Part(
        part.name, solid, tuple(hull @ rotation.T + shift for hull in part.hulls), part.reflectance
    )


def _ovals(
    heights: np.ndarray, half_width: np.ndarray, half_depth: np.ndarray, around: int = 48
) -> np.ndarray:
    """(m, around, 3) horizontal ellipses; point i mirrors point around-1-i, as `loft` wants."""
    angle = (np.arange(around) + 0.5) / around * 2.0 * np.pi
    x = half_depth[:, None] * np.cos(angle)
    y = half_width[:, None] * np.sin(angle)
    return np.stack([x, y, np.broadcast_to(heights[:, None], x.shape)], axis=-1)
