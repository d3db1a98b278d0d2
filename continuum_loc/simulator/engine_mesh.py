"""
The front compressor section of a jet engine, 3.1 m in outer diameter, as parts to be united.

The engine's axis is the map's x; air flows to +x; the robot's base is at about (-0.2, 0, 1.0) and
looks along +x, through the gaps that every row has at azimuth 0. Blade rows repeat round the axis
(the symmetry that misleads a ToF-only estimate); struts, ports, bosses, pipes, weights and the
blades' own small differences break it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

from continuum_loc.simulator.solids import (
    box,
    convex_part,
    cut_hulls,
    cylinder,
    Hulls,
    lathe,
    loft,
    on_cylinder,
    Part,
    wrap,
)
from manifold3d import Manifold
import numpy as np

OUTER_RADIUS = 1.55
INLET, OUTLET = -0.15, 2.75
_NOSE_TIP, _NOSE_END = -0.25, 0.25
_HUB_RADIUS = (0.40, 0.58)  # at the nose's end and at the outlet
_CASING_RADIUS = (1.50, 1.47)  # at the inlet and at the outlet
_RUB_STRIP_DEPTH = 0.012
_CONTACT_AZIMUTH = 75.0  # the robot cannot reach farther round than this [deg]
_CONTACT_END = 2.2
_SECTION_POINTS = 19  # per side of a blade section
_SPAN_SECTIONS = 21
_TITANIUM, _STEEL, _PAINT, _RUBBER = 0.55, 0.45, 0.75, 0.25


def hub_radius(x: float | np.ndarray) -> np.ndarray:
    """Outer radius of the hub [m] at axial position x: an elliptic nose, then a slow taper."""
    along_nose = np.clip(
        (_NOSE_END - np.asarray(x, dtype=float)) / (_NOSE_END - _NOSE_TIP), 0.0, 1.0
    )
    nose = _HUB_RADIUS[0] * np.sqrt(1.0 - along_nose**2)
    return np.where(along_nose > 0.0, nose, np.interp(x, (_NOSE_END, OUTLET), _HUB_RADIUS))


def casing_radius(x: float | np.ndarray) -> np.ndarray:
    """Inner radius of the casing [m] at axial position x, rub strips left out."""
    return np.interp(x, (INLET, OUTLET), _CASING_RADIUS)


@dataclass(frozen=True)
class BladeRow:
    """
    A row of identical blades.

    Rotors are twisted as tan(stagger) proportional to radius, vanes are not twisted.
    """

    name: str
    count: int
    x: float
    chord: float
    stagger_deg: float  # at 1 m radius
    camber: float  # height of the camber line over the chord
    thickness: float  # over the chord
    rotating: bool
    first_azimuth_deg: float

    def sections(self, index: int) -> np.ndarray:
        """
        (m, n, 3) sections of blade `index`, hub to casing.

        Blades differ by their place in the row: a little stagger, chord and azimuth each, as in a
        real, mistuned row.
        """
        variation = np.random.default_rng([self.count, index]).uniform(-1.0, 1.0, 3)
        radii = np.linspace(*self._span(), _SPAN_SECTIONS)
        azimuth = self.azimuth(index) + np.radians(0.4) * variation[0]
        stagger = self._stagger(radii) + np.radians(1.5) * variation[1]
        chord = self.chord * (1.0 + 0.04 * variation[2])
        axial, tangential = _section(
            chord, self.camber * np.sign(self.stagger_deg), self.thickness
        )
        cos, sin = np.cos(stagger)[:, None], np.sin(stagger)[:, None]
        x = self.x + cos * axial - sin * tangential
        arc = sin * axial + cos * tangential
        return wrap(x, azimuth + arc / radii[:, None], radii[:, None])

    def azimuth(self, index: int) -> float:
        """Nominal azimuth of a blade's stacking line [rad]."""
        return np.radians(self.first_azimuth_deg) + index * 2.0 * np.pi / self.count

    def _span(self) -> tuple[float, float]:
        # Embedded, so that the union has no gap under the twisted root.
        root = float(hub_radius(self.x)) - 0.03
        casing = float(casing_radius(self.x))
        return root, casing + (_RUB_STRIP_DEPTH / 3.0 if self.rotating else 0.015)

    def _stagger(self, radii: np.ndarray) -> np.ndarray:
        at_one_metre = np.radians(self.stagger_deg)
        return (
            np.arctan(np.tan(at_one_metre) * radii)
            if self.rotating
            else np.full_like(radii, at_one_metre)
        )


def _gap_at_top(count: int) -> float:
    """Azimuth [deg] of the first blade: the gap for the robot is then at azimuth 0."""
    return 180.0 / count


ROWS = (
    BladeRow('strut', 6, 0.29, 0.34, 0.0, 0.0, 0.11, False, _gap_at_top(6)),
    BladeRow('guide_vane', 14, 0.70, 0.18, 10.0, 0.04, 0.10, False, _gap_at_top(14)),
    BladeRow('rotor1', 16, 1.05, 0.26, -28.0, 0.05, 0.07, True, _gap_at_top(16)),
    BladeRow('stator1', 20, 1.55, 0.18, 20.0, 0.06, 0.09, False, _gap_at_top(20)),
    BladeRow('rotor2', 28, 1.95, 0.20, -30.0, 0.05, 0.07, True, _gap_at_top(28)),
    BladeRow('stator2', 36, 2.40, 0.14, 22.0, 0.06, 0.09, False, _gap_at_top(36)),
)


def engine_parts() -> list[Part]:
    """All parts of the engine as built (scene S0)."""
    blades = [_blade(row, index) for row in ROWS for index in range(row.count)]
    return [_casing(), _hub(), *blades, *_casing_fittings(), *_hub_fittings()]


def leading_edge(blade: str, radius: float) -> np.ndarray:
    """(3,) point on a blade's (`rotor1_0`) leading edge, `radius` [m] from the axis."""
    sections = _find_row(blade).sections(_index(blade))
    edge = 0.5 * (sections[:, 0] + sections[:, -1])
    radii = np.hypot(edge[:, 1], edge[:, 2])
    return np.array([np.interp(radius, radii, edge[:, axis]) for axis in range(3)])


def bitten(blade: Part, radius: float, size: float) -> tuple[Part, Manifold]:
    """
    Blade with a round bite of diameter `size` [m] in its leading edge, and the piece that went.

    The contact pieces are re-cut finely, so that the robot feels the gap to about a centimetre.
    """
    cutter = Manifold.sphere(size / 2.0, 48).translate(leading_edge(blade.name, radius))
    fine = _blade_hulls(
        _find_row(blade.name).sections(_index(blade.name)), chord_pieces=6, span_pieces=14
    )
    hulls = cut_hulls(fine, cutter) if blade.hulls else ()
    return replace(blade, solid=blade.solid - cutter, hulls=hulls), blade.solid ^ cutter


def _find_row(blade: str) -> BladeRow:
    return next(row for row in ROWS if row.name == blade.rpartition('_')[0])


def _index(blade: str) -> int:
    return int(blade.rpartition('_')[2])


def _section(chord: float, camber: float, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Draw a cambered NACA four-digit-like section about mid-chord.

    (2n,) axial and tangential coordinates: to the tail on the suction side, back on the other.
    """
    u = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, _SECTION_POINTS)))
    half = (
        5.0
        * thickness
        * (0.2969 * np.sqrt(u) - 0.1260 * u - 0.3516 * u**2 + 0.2843 * u**3 - 0.1015 * u**4)
    )
    # Blunt edges: real ones are rounded, and knife edges break mesh unions.
    half = np.maximum(half, 0.004)
    middle = 4.0 * camber * u * (1.0 - u)
    axial = np.concatenate([u, u[::-1]]) - 0.5
    return chord * axial, chord * np.concatenate([middle + half, (middle - half)[::-1]])


def _blade(row: BladeRow, index: int) -> Part:
    sections = row.sections(index)
    azimuth_deg = (np.degrees(row.azimuth(index)) + 180.0) % 360.0 - 180.0
    reachable = abs(azimuth_deg) < _CONTACT_AZIMUTH and row.x < _CONTACT_END
    hulls = _blade_hulls(sections) if reachable else ()
    return Part(f'{row.name}_{index}', loft(sections), hulls, _TITANIUM)


def _blade_hulls(sections: np.ndarray, chord_pieces: int = 2, span_pieces: int = 5) -> Hulls:
    """Convex pieces along span and chord: twist and camber make a blade concave."""
    side = sections.shape[1] // 2
    upper, lower = sections[:, :side], sections[:, side:][:, ::-1]
    return tuple(
        np.concatenate([upper[span, chord], lower[span, chord]]).reshape(-1, 3)
        for span in _adjoining(len(sections), span_pieces)
        for chord in _adjoining(side, chord_pieces)
    )


def _adjoining(count: int, pieces: int) -> list[slice]:
    """Slices of about equal length of `count` rows, each beginning with the last one's end."""
    ends = np.linspace(0, count - 1, pieces + 1).round().astype(int)
    return [slice(first, last + 1) for first, last in pairwise(ends)]


def _casing() -> Part:
    stations = [INLET + 0.05]
    for row in ROWS:
        if row.rotating:
            stations += [row.x - 0.16, row.x - 0.155, row.x + 0.155, row.x + 0.16]
    stations = np.array([*stations, OUTLET])
    in_strip = [any(row.rotating and abs(x - row.x) < 0.158 for row in ROWS) for x in stations]
    bore = np.column_stack(
        [stations, casing_radius(stations) + np.where(in_strip, _RUB_STRIP_DEPTH, 0.0)]
    )
    lip_angle = np.linspace(0.0, np.pi, 9)[:-1]
    lip_radius = (OUTER_RADIUS - casing_radius(INLET + 0.05)) / 2.0
    lip = np.column_stack(
        [
            INLET + 0.05 - 0.05 * np.sin(lip_angle),
            casing_radius(INLET + 0.05) + lip_radius * (1.0 + np.cos(lip_angle)),
        ]
    )
    shell = lathe(np.concatenate([lip, bore, [[OUTLET, OUTER_RADIUS]]]), segments=300)
    for x, azimuth, radius in _PORTS:
        shell -= on_cylinder(cylinder(radius, 0.08), x, azimuth, float(casing_radius(x)))
    return Part('casing', shell, _casing_hulls(), _STEEL)


def _casing_hulls(step_deg: float = 5.0) -> Hulls:
    """Wall slabs of a few degrees each; the flat inner face straddles the true arc."""
    edges = np.arange(-_CONTACT_AZIMUTH, _CONTACT_AZIMUTH + 1e-9, step_deg)
    bulge = 1.0 + 0.5 * (1.0 - np.cos(np.radians(step_deg / 2.0)))
    ends = np.array([INLET, _CONTACT_END])
    x = np.tile(ends, 2)
    radius = np.concatenate([casing_radius(ends) * bulge, casing_radius(ends) + 0.06])
    return tuple(
        np.concatenate([wrap(x, np.radians(edge), radius) for edge in pair])
        for pair in pairwise(edges)
    )


def _hub() -> Part:
    nose = _NOSE_END - (_NOSE_END - _NOSE_TIP) * np.cos(np.linspace(0.0, np.pi / 2.0, 15))
    stations = np.append(nose, [0.8, 1.4, 2.0, OUTLET])
    profile = np.column_stack([stations, hub_radius(stations)])
    profile[0, 1] = 0.0  # exactly on the axis: a hole of 10 nm would be left otherwise
    solid = lathe(np.concatenate([profile, [[OUTLET, 0.0]]]), segments=180)
    return Part('hub', solid, _hub_hulls(stations), _PAINT)


def _hub_hulls(stations: np.ndarray) -> Hulls:
    """Convex pieces of the hub: its nose, and each of the cones behind it."""
    azimuths = np.radians(np.linspace(-_CONTACT_AZIMUTH, _CONTACT_AZIMUTH, 51))
    nose = stations[stations <= _NOSE_END + 1e-9]
    last = len(nose) - 1
    pieces = [nose, *pairwise(stations[last:])]

    def wedge(x: np.ndarray) -> np.ndarray:
        surface = wrap(x[:, None], azimuths, hub_radius(x)[:, None]).reshape(-1, 3)
        return np.concatenate([surface, wrap(x[[0, -1]], 0.0, 0.0)])

    return tuple(wedge(np.asarray(piece)) for piece in pieces)


# Borescope ports, blind holes in the casing: x, azimuth [deg], radius.
_PORTS = (
    (0.50, -4.0, 0.030),
    (0.86, 10.0, 0.035),
    (1.30, -16.0, 0.040),
    (1.755, 12.0, 0.030),
    (0.05, 6.0, 0.025),
)
# Bosses on the casing: x, azimuth [deg], radius, height.
_BOSSES = (
    (0.30, -12.0, 0.050, 0.05),
    (0.52, 14.0, 0.035, 0.07),
    (0.87, -20.0, 0.060, 0.04),
    (1.32, 8.0, 0.045, 0.06),
    (1.74, -10.0, 0.040, 0.05),
    (0.02, -22.0, 0.040, 0.06),
)
# Balance weights on the hub: x, azimuth [deg], circumferential width.
_WEIGHTS = (
    (1.33, -31.0, 0.10),
    (1.33, -9.0, 0.14),
    (1.33, 7.0, 0.08),
    (1.33, 27.0, 0.12),
    (1.73, -12.0, 0.09),
    (1.73, 18.0, 0.13),
)


def _casing_fittings() -> list[Part]:
    bosses = [_boss(i, *place) for i, place in enumerate(_BOSSES)]
    junction = on_cylinder(box((0.12, 0.16, 0.18)), 0.86, 24.0, float(casing_radius(0.86)))
    axial = partial(cylinder, 0.022, segments=24)
    pipes = [
        convex_part(
            'pipe_inlet',
            on_cylinder(axial(0.55).rotate((0.0, 90.0, 0.0)), 0.25, 21.0, 1.475),
            _RUBBER,
        ),
        convex_part(
            'pipe_stage1',
            on_cylinder(axial(0.20).rotate((0.0, 90.0, 0.0)), 1.34, 17.0, 1.465),
            _RUBBER,
        ),
    ]
    panels = [
        _panel('liner_left', (-0.05, 0.42), (-58.0, -34.0), 0.02),
        _panel('liner_right', (1.24, 1.42), (26.0, 52.0), 0.025),
        _panel('manifold', (1.27, 1.33), (-60.0, -22.0), 0.05),
    ]
    return [*bosses, convex_part('junction_box', junction, _PAINT), *pipes, *panels]


def _boss(index: int, x: float, azimuth_deg: float, radius: float, height: float) -> Part:
    solid = on_cylinder(cylinder(radius, 2.0 * height), x, azimuth_deg, float(casing_radius(x)))
    return convex_part(f'boss_{index}', solid, _STEEL)


def _panel(
    name: str, x: tuple[float, float], azimuth_deg: tuple[float, float], height: float
) -> Part:
    """Raise a patch of the casing's wall, in contact pieces of about 4 degrees."""
    inner = casing_radius(np.array(x)) - height
    profile = np.array([[x[0], inner[0]], [x[1], inner[1]], [x[1], 1.52], [x[0], 1.52]])
    count = round((azimuth_deg[1] - azimuth_deg[0]) / 4.0)
    edges = np.radians(np.linspace(*azimuth_deg, count + 1))
    hulls = tuple(
        wrap(profile[:, :1], np.array(pair), profile[:, 1:]).reshape(-1, 3)
        for pair in pairwise(edges)
    )
    return Part(name, lathe(profile, segments=12 * count, azimuth_deg=azimuth_deg), hulls, _PAINT)


def _hub_fittings() -> list[Part]:
    weights = [
        convex_part(
            f'weight_{i}',
            on_cylinder(box((0.06, width, 0.08)), x, azimuth, float(hub_radius(x))),
            _STEEL,
        )
        for i, (x, azimuth, width) in enumerate(_WEIGHTS)
    ]
    bolts = [_bolt(i, 360.0 / 18 * i) for i in range(18)]
    cover = on_cylinder(box((0.16, 0.20, 0.07)), 0.86, 4.0, float(hub_radius(0.86)))
    ring = lathe(np.array([[1.66, 0.3], [1.66, 0.52], [1.69, 0.52], [1.69, 0.3]]), segments=180)
    return [
        *weights,
        *bolts,
        convex_part('service_cover', cover, _PAINT),
        Part('seal_ring', ring, (), _STEEL),
    ]


def _bolt(index: int, azimuth_deg: float) -> Part:
    head = on_cylinder(
        cylinder(0.024, 0.06, segments=6), 0.52, azimuth_deg, float(hub_radius(0.52))
    )
    part = convex_part(f'bolt_{index}', head, _STEEL)
    near = min(azimuth_deg, 360.0 - azimuth_deg) < _CONTACT_AZIMUTH
    return part if near else replace(part, hulls=())
