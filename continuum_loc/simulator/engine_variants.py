"""
Scenes S1-S9: the engine with objects left behind, with features gone, or with both; H1-H3 to tune.

Anomalies are 3-15 cm long and lie on the walls and blades round the robot's way (azimuth 0, 1 m
from the axis). Their truth is exact: the solid that the variant has and the engine as built has
not, or the reverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from continuum_loc.simulator.engine_mesh import (
    bitten,
    casing_radius,
    engine_parts,
    hub_radius,
    leading_edge,
)
from continuum_loc.simulator.scene import Anomaly, Scene, scene_of_solid
from continuum_loc.simulator.solids import (
    box,
    cylinder,
    mesh_of,
    on_cylinder,
    Part,
    unite,
    vertices_of,
)
from manifold3d import Manifold
import numpy as np

# Objects sink this far into what carries them, so that the union leaves no crack [m].
_EMBED = 0.004


@dataclass(frozen=True)
class Left:
    """An object on the hub or stuck to the casing at (x, azimuth), turned about the normal."""

    what: str
    wall: str
    x: float
    azimuth_deg: float
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Lodged:
    """An object caught on a blade's leading edge."""

    what: str
    blade: str
    radius: float


@dataclass(frozen=True)
class Gone:
    """A fitting that is not there."""

    part: str


@dataclass(frozen=True)
class Bite:
    """A round piece of diameter `size` out of a blade's leading edge."""

    blade: str
    radius: float
    size: float


Change = Left | Lodged | Gone | Bite

VARIANTS: dict[str, tuple[Change, ...]] = {
    'S1': (
        Left('bolt', 'hub', 0.72, 5.0, 30.0),
        Left('ball', 'casing', 1.26, -3.0),
        Lodged('nut', 'rotor1_0', 1.10),
    ),
    'S2': (
        Left('wrench', 'hub', 1.24, -3.0, 65.0),
        Left('rag', 'casing', 0.62, 3.0),
        Left('bracket', 'hub', 0.60, -8.0),
        Lodged('ball', 'stator1_19', 0.95),
    ),
    'S3': (
        Left('clamp', 'casing', 0.62, -7.0, 20.0),
        Left('can', 'hub', 1.80, 4.0),
        Left('bolt', 'hub', 0.62, 14.0, 80.0),
        Lodged('rag', 'stator1_0', 1.15),
    ),
    'S4': (Gone('boss_1'), Gone('weight_1'), Bite('rotor1_15', 0.90, 0.09)),
    'S5': (Gone('boss_3'), Gone('bolt_0'), Gone('weight_5'), Bite('stator1_0', 1.05, 0.06)),
    'S6': (
        Gone('boss_2'),
        Gone('weight_2'),
        Gone('bolt_1'),
        Bite('guide_vane_13', 1.20, 0.12),
        Bite('rotor1_0', 0.80, 0.07),
    ),
    'S7': (
        Left('bracket', 'casing', 1.26, -6.0, 40.0),
        Left('ball', 'hub', 0.66, 2.0),
        Gone('boss_3'),
        Bite('rotor1_0', 1.05, 0.08),
    ),
    'S8': (
        Left('rag', 'hub', 1.22, 1.0),
        Lodged('nut', 'guide_vane_0', 1.05),
        Gone('boss_1'),
        Gone('weight_4'),
        Bite('stator1_19', 0.90, 0.07),
    ),
    'S9': (
        Left('wrench', 'casing', 0.64, 6.0, 25.0),
        Left('can', 'hub', 1.24, -6.0),
        Lodged('rag', 'rotor1_15', 1.20),
        Gone('boss_3'),
        Gone('weight_5'),
        Gone('bolt_17'),
        Bite('stator1_0', 0.95, 0.10),
    ),
    # For choosing a detector's thresholds, never for reporting what it reaches.
    'H1': (
        Left('can', 'hub', 0.70, -6.0),
        Left('nut', 'casing', 0.66, 2.0),
        Lodged('bolt', 'rotor1_15', 1.0),
        Gone('weight_3'),
        Bite('guide_vane_0', 0.95, 0.08),
    ),
    'H2': (
        Left('ball', 'hub', 1.22, 6.0),
        Left('clamp', 'hub', 0.62, 6.0, 50.0),
        Lodged('nut', 'stator1_0', 1.0),
        Gone('boss_2'),
        Gone('bolt_2'),
        Bite('stator1_19', 1.1, 0.06),
    ),
    'H3': (
        Left('bolt', 'casing', 1.25, 3.0, 10.0),
        Left('bracket', 'hub', 1.8, -4.0),
        Lodged('ball', 'guide_vane_13', 1.0),
        Gone('boss_1'),
        Gone('bolt_16'),
        Bite('rotor1_15', 1.05, 0.07),
        Bite('rotor1_0', 0.95, 0.05),
    ),
}


def engine_variant(name: str) -> Scene:
    """Scene S0 (as built) or one of its variants, with the truth of every change."""
    built = {part.name: part for part in engine_parts()}
    parts = dict(built)
    bodies = [(change, _apply(change, parts)) for change in VARIANTS.get(name, ())]
    solid, owners = unite(list(parts.values()))
    anomalies: tuple[Anomaly, ...] = ()
    if bodies:
        as_built, _ = unite(list(built.values()))
        anomalies = tuple(_anomaly(change, body, as_built, solid) for change, body in bodies)
    return scene_of_solid(name, solid, owners, list(parts.values()), anomalies)


def _apply(change: Change, parts: dict[str, Part]) -> Manifold:
    """Make one change to the parts; returns the solid that came or went."""
    if isinstance(change, Gone):
        return parts.pop(change.part).solid
    if isinstance(change, Bite):
        parts[change.blade], piece = bitten(parts[change.blade], change.radius, change.size)
        return piece
    placed = _placed(change)
    parts[placed.name] = placed
    return placed.solid


def _anomaly(change: Change, body: Manifold, as_built: Manifold, changed: Manifold) -> Anomaly:
    """Keep what of `body` only one scene has: what sinks into a wall does not count."""
    if isinstance(change, Left | Lodged):
        return Anomaly(change.what, 'added', *mesh_of(_largest(body - as_built)))
    name = change.part if isinstance(change, Gone) else f'{change.blade}_edge'
    return Anomaly(name, 'missing', *mesh_of(_largest(body - changed)))


def _largest(solid: Manifold) -> Manifold:
    """Keep the largest connected piece, without the slivers that subtraction leaves."""
    return max(solid.decompose(), key=lambda piece: piece.volume())


def _placed(change: Left | Lodged) -> Part:
    pieces = _OBJECTS[change.what]()
    low = min(piece.bounding_box()[2] for piece in pieces)
    if isinstance(change, Lodged):
        edge = leading_edge(change.blade, change.radius)
        azimuth = float(np.degrees(np.arctan2(edge[1], edge[2])))
        place = (edge[0], azimuth, change.radius, 0.0)
        low = 0.0
    elif change.wall == 'hub':
        place = (
            change.x,
            change.azimuth_deg,
            float(hub_radius(change.x)) - low - _EMBED,
            change.turn_deg,
        )
    else:
        place = (
            change.x,
            change.azimuth_deg,
            float(casing_radius(change.x)) + low + _EMBED,
            change.turn_deg,
        )
    moved = [on_cylinder(piece, *place) for piece in pieces]
    return Part(
        change.what, sum(moved[1:], moved[0]), tuple(vertices_of(piece) for piece in moved), 0.6
    )


# Objects as convex pieces, lying flat with z up; metres.


def _bolt() -> Sequence[Manifold]:
    along_x = (0.0, 90.0, 0.0)
    shank = cylinder(0.008, 0.045, 20).rotate(along_x)
    return shank, cylinder(0.014, 0.012, 6).rotate(along_x).translate((0.026, 0.0, 0.0))


def _nut() -> Sequence[Manifold]:
    return (cylinder(0.016, 0.024, 6),)


def _ball() -> Sequence[Manifold]:
    return (Manifold.sphere(0.022, 32),)


def _rag() -> Sequence[Manifold]:
    lumps = (
        (0.0, 0.0, 0.0, 0.034),
        (0.030, 0.012, -0.006, 0.026),
        (-0.026, 0.016, -0.008, 0.024),
        (0.004, -0.030, -0.006, 0.026),
    )
    return tuple(
        Manifold.sphere(r, 28).scale((1.0, 1.0, 0.8)).translate((x, y, z)) for x, y, z, r in lumps
    )


def _bracket() -> Sequence[Manifold]:
    return box((0.08, 0.05, 0.008)), box((0.008, 0.05, 0.06)).translate((0.036, 0.0, 0.03))


def _wrench() -> Sequence[Manifold]:
    jaws = (
        box((0.030, 0.012, 0.014)).translate((0.058, side * 0.014, 0.0)) for side in (-1.0, 1.0)
    )
    return (
        box((0.088, 0.018, 0.014)),
        *jaws,
        cylinder(0.020, 0.014, 24).translate((0.034, 0.0, 0.0)),
    )


def _clamp() -> Sequence[Manifold]:
    arms = (
        box((0.020, 0.080, 0.025)).translate((side * 0.050, 0.030, 0.0)) for side in (-1.0, 1.0)
    )
    return box((0.12, 0.020, 0.025)), *arms


def _can() -> Sequence[Manifold]:
    return (cylinder(0.033, 0.09, 40),)


_OBJECTS = {
    'bolt': _bolt,
    'nut': _nut,
    'ball': _ball,
    'rag': _rag,
    'bracket': _bracket,
    'wrench': _wrench,
    'clamp': _clamp,
    'can': _can,
}
