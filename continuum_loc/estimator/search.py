"""
The search for a bent body: a beam search along it, ring by ring.

It needs the base and the map alone. Each segment bends with a curvature from a grid round zero, a
partial body is scored by the zones of the rings that it has reached, and the best, mutually
different ones go on. It needs no initial guess and no randomness, so that a replay finds the same.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.compiling import kernel
from continuum_loc.estimator.factors.tof import Row, TofFactor
from continuum_loc.estimator.matching import Frame, match, Rules, Surface, thinned, weigh
from continuum_loc.estimator.normal import new_normal
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import RecoverySettings
from continuum_loc.estimator.state import Grid
import numpy as np

# [m] of the thinned map that the search scores against; it has to tell decimetres apart.
COARSE_SPACING = 0.04
ZONE_STRIDE = 3  # zones are smooth over their neighbours: a third of them tells hypotheses apart


class Snapshot(NamedTuple):
    """The newest frame of each ToF sensor, thinned: its node, its zones (F, Z, 3), their beams."""

    nodes: np.ndarray
    q: np.ndarray
    rays: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, rows: list[Row]) -> Snapshot:
        """From a ToF factor's rows, in order of arrival."""
        newest = {row.sensor: row for row in rows}
        rows = [newest[sensor] for sensor in sorted(newest)]
        zones = (
            np.array([getattr(row, part)[::ZONE_STRIDE] for row in rows])
            for part in ('q', 'rays', 'variance')
        )
        return cls(np.array([row.node for row in rows]), *zones)

    def at(self, node: int) -> Snapshot:
        """Keep the frames of one node."""
        return Snapshot(*(part[self.nodes == node] for part in self))


class Beam(NamedTuple):
    """Partial bodies (M): pose (4, 4) of the end, cost, and curvature (2,) of each segment."""

    T: np.ndarray
    cost: np.ndarray
    bends: np.ndarray


class ShapeSearch:
    """Beam search over bent shapes for the ones that a snapshot fits."""

    def __init__(self, grid: Grid, tof: TofFactor, settings: RecoverySettings, priors: Priors):
        self.grid, self.settings, self.rest = grid, settings, priors.rest
        # Base and rings, each place once: a ring on the base has no segment of its own.
        self._nodes = np.unique(grid.ring_nodes)
        self._s = grid.s[self._nodes]
        options, self._tof = tof.settings.tof, tof
        self._thinned: Surface | None = None
        self._rules = Rules(
            gate=settings.score_gate,
            min_cosine=options.min_cosine,
            reassociate=0.0,
            floor2=settings.score_floor**2,
            footprint=0.0,
            cauchy=options.acquisition_cauchy,
        )
        count = int(round(settings.max_curvature / settings.curvature_step))
        steps = settings.curvature_step * np.arange(-count, count + 1)
        pairs = np.stack(np.meshgrid(steps, steps, indexing='ij'), -1).reshape(-1, 2)
        self.curvatures = pairs[np.hypot(*pairs.T) <= settings.max_curvature + 1e-9]
        self._bending_psd = float(np.mean(priors.strain_psd[~grid.steps, 4:]))

    @property
    def _surface(self) -> Surface:
        """Return the thinned map, made at the first search."""
        if self._thinned is None:
            self._thinned = thinned(self._tof.surface, COARSE_SPACING)
        return self._thinned

    def find(self, T_map_base: np.ndarray, snapshot: Snapshot) -> list[np.ndarray]:
        """Strain (N, 6) at the nodes of the best shapes, best first."""
        beam = Beam(T_map_base[None], np.zeros(1), np.zeros((1, 0, 2)))
        for node, length in zip(self._nodes[1:], np.diff(self._s), strict=True):
            beam = self._extend(beam, length, snapshot.at(node))
        return [self._strain_at_nodes(bend) for bend in beam.bends[: self.settings.refined]]

    def _extend(self, beam: Beam, length: float, snapshot: Snapshot) -> Beam:
        """Add a segment to every partial body in every way, and keep the best."""
        bends, parents, grid = beam.bends, len(beam.T), len(self.curvatures)
        strain = np.tile(self.rest, (grid, 1))
        strain[:, 4:] += self.curvatures
        ends = (beam.T[:, None] @ lie.exp(length * strain)[None]).reshape(-1, 4, 4)
        scores = _score(ends, snapshot, self._surface, self._rules)
        before = bends[:, -1] if bends.shape[1] else np.zeros((parents, 2))
        change = np.sum((self.curvatures[None] - before[:, None]) ** 2, axis=2) / (
            self._bending_psd * length
        )
        total = (beam.cost[:, None] + 0.5 * change).ravel() + scores
        chosen = self._different(total, ends)
        grown = np.concatenate(
            [bends[chosen // grid], self.curvatures[chosen % grid][:, None]], axis=1
        )
        return Beam(ends[chosen], total[chosen], grown)

    def _different(self, total: np.ndarray, T: np.ndarray) -> np.ndarray:
        """Best `beam` candidates, no two of which lie within `distinct` of one another."""
        chosen: list[int] = []
        for candidate in np.argsort(total, kind='stable'):
            gaps = [np.linalg.norm(T[candidate, :3, 3] - T[c, :3, 3]) for c in chosen]
            if not gaps or min(gaps) >= self.settings.distinct:
                chosen.append(int(candidate))
            if len(chosen) == self.settings.beam:
                break
        return np.array(chosen)

    def _strain_at_nodes(self, bends: np.ndarray) -> np.ndarray:
        """Strain (N, 6) whose curvature runs through the segments' curvatures at their middles."""
        middles = 0.5 * (self._s[1:] + self._s[:-1])
        strain = np.tile(self.rest, (self.grid.nodes, 1))
        for i in range(2):
            strain[:, 4 + i] += np.interp(self.grid.s, middles, bends[:, i])
        return strain


@kernel
def _score(T, snapshot, surface, rules):
    """Robust cost (M,) of the frames at each pose T (M, 4, 4)."""
    zones = snapshot.q.shape[1]
    local, tally, hits = new_normal(6), np.zeros(2), np.empty(zones, np.int64)
    nowhere = np.full((zones, 4), np.nan)
    out = np.zeros(T.shape[0])
    for m in range(T.shape[0]):
        for f in range(snapshot.q.shape[0]):
            frame = Frame(
                snapshot.q[f], snapshot.rays[f], snapshot.variance[f], hits, nowhere.copy()
            )
            match(T[m], frame, surface.lookup, rules)
            cost, _, _ = weigh(T[m], frame, 1.0, surface.planes, rules, local, tally)
            out[m] += cost
    return out
