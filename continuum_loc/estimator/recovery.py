"""
Lost and found: noticing that the body is in a wrong minimum, and finding it again.

The search needs the base and the map alone.

A wrong minimum shows in the share of ToF zones that fit the map. A low share alone is no proof
(the scene may differ from the map), so a suspicion leads to a search of all shapes: where nothing
fits better, the filter was right.

The search goes along the body, ring by ring, as a beam search: each segment bends with a curvature
from a grid round zero, a partial body is scored by the zones of the rings it has reached, and the
best, mutually different ones go on. It needs no initial guess and no randomness, so a replay finds
the same.
"""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc import lie
from continuum_loc.estimate import Status
from continuum_loc.estimator.factors.tof import associate, frame_information, TofFactor
from continuum_loc.estimator.health import Health
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import RecoverySettings
from continuum_loc.estimator.state import Column, Grid, shape_from_strain
from continuum_loc.estimator.window import Window
from continuum_loc.robot import RobotDescription
from numba import njit
import numpy as np

# [m] of the thinned map that the search scores against; it has to tell decimetres apart.
COARSE_SPACING = 0.04
ZONE_STRIDE = 3  # zones are smooth over their neighbours: a third of them tells hypotheses apart
SEARCH_INTERVALS = 2  # the newest, whose measurements decide between bodies
GATE_SHRINK = 0.75  # of the gate of association, at each iteration from a guess
SHARE_SLACK = 0.02  # of fitting zones, by which two bodies explain about as much
AMBIGUOUS = 0.03  # [m] bodies closer than this at every ring are the same one
BACKOFF_LIMIT = 8.0  # [s] longest time between two searches of a body that stays suspect


@dataclass(slots=True)
class Watch:
    """
    Whether the body is to be believed.

    Suspicion, and when to search next (times in seconds of data).
    """

    settings: RecoverySettings
    since: float | None = None
    next_search: float = 0.0
    backoff: float = 1.0
    lost: bool = False

    def update(self, time: float, worst_share: float) -> bool:
        """Note the least share of fitting zones over the rings; True when a search is due."""
        if worst_share >= self.settings.suspect_share:
            self.since, self.backoff, self.lost, self.next_search = None, 1.0, False, time
            return False
        self.since = time if self.since is None else self.since
        return time - self.since >= self.settings.patience and time >= self.next_search

    def searched(self, time: float, confirmed: bool) -> None:
        """Note a search's outcome: a body that nothing beats is believed, whatever its share."""
        self.lost = not confirmed
        self.backoff = min(2.0 * self.backoff, BACKOFF_LIMIT)
        self.next_search = time + self.backoff


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """
    The newest frame of each ToF sensor.

    nodes (F,), zones q and rays (F, Z, 3) in the node's frame, variance (F, Z).
    """

    nodes: np.ndarray
    q: np.ndarray
    rays: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, rows: list[tuple]) -> Snapshot:
        """From a ToF factor's rows, in order of arrival."""
        newest = {row[0]: row for row in rows}
        _, nodes, q, rays, variance, _ = zip(
            *(newest[sensor] for sensor in sorted(newest)), strict=True
        )
        return cls(
            np.array(nodes),
            *(np.ascontiguousarray(np.array(x)[:, ::ZONE_STRIDE]) for x in (q, rays, variance)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Try:
    """
    A body that was tried.

    Cost of its measurements, mean share of zones that fit, number of sensors of which (nearly)
    all do, its columns.
    """

    cost: float
    share: float
    whole: int
    columns: list[Column]


class Recovery:
    """
    Acquires the body at the start, watches over it, and finds it again.

    acquired: whether the filter tracks.
    """

    def __init__(
        self,
        robot: RobotDescription,
        window: Window,
        tof: TofFactor | None,
        health: Health,
        settings: RecoverySettings,
    ):
        self.acquired = False
        self._robot, self._window, self._tof, self._settings = robot, window, tof, settings
        self._health, self._watch = health, Watch(settings)
        self._doubt = 0.0
        self._shapes = (
            None if tof is None else ShapeSearch(window.grid, tof, settings, window.priors)
        )

    @property
    def status(self) -> Status:
        """Say what to tell of the body."""
        if self._watch.lost:
            return 'lost'
        return 'tracking' if self.acquired else 'initialising'

    def doubt(self, s: np.ndarray) -> np.ndarray:
        """
        (m, 6, 6) covariance to add at arclengths s (m,) while in doubt or lost.

        It grows from base to tip.
        """
        reach = self._doubt * (s / self._window.grid.s[-1])[:, None]
        return np.square(reach * np.repeat(self._settings.lost_sigma, 3))[:, :, None] * np.eye(6)

    def acquire(self) -> tuple[int, bool]:
        """
        Solve the window from a guess: (iterations, whether it converged).

        The loss is tighter than when tracking: a wrong body must not pay for few far zones by many
        near ones. Every zone is matched anew at each iteration, as a body that comes from afar may
        otherwise halt where its next step moves none of them far enough.
        """
        if self._tof is None:
            return self._window.acquire(lambda iteration: True)
        tof, options = self._tof, self._tof.settings.tof
        tof.cauchy, tof.reassociate = options.acquisition_cauchy, 0.0
        outcome = self._window.acquire(self._narrow)
        tof.cauchy, tof.reassociate = options.cauchy, options.reassociate
        return outcome

    def look_after(self, time: float, converged: bool) -> None:
        """Notice a wrong minimum by the worst ring's fitting share, and look for a better body."""
        self._health.look(time, body_believed=False, body_doubted=self._watch.since is not None)
        if self._tof is None or not self._settings.enabled:
            self.acquired = self.acquired or converged
            return
        share = self._worst_share()
        fitting = share >= self._settings.suspect_share
        self.acquired = self.acquired or (converged and fitting)
        due = self._watch.update(time, share)
        if due or (not fitting and not self.acquired and time >= self._watch.next_search):
            confirmed = self._search()
            self._watch.searched(time, confirmed)
            if confirmed:
                self._health.look(time, body_believed=True, body_doubted=True)
        self._doubt = self._how_doubtful(self._worst_share())

    def _narrow(self, iteration: int) -> bool:
        """Gate association: wide while the shape is a guess, then down to the tracking gate."""
        options = self._tof.settings.tof
        gate = max(options.gate, options.acquisition_gate * GATE_SHRINK**iteration)
        if gate != self._tof.gate:
            self._tof.gate = gate
            self._window.mark_changed()
        return gate <= options.gate

    def _worst_share(self) -> float:
        """
        Least share of fitting zones over the rings, in the newest interval with ToF frames.

        Sensors that are themselves suspect do not count.
        """
        fits = self._window.newest_fits('tof')
        by_ring: dict[str, np.ndarray] = {}
        for sensor in self._robot.tof:
            if sensor.name in fits and sensor.name not in self._health.reasons:
                by_ring[sensor.ring] = by_ring.get(sensor.ring, 0.0) + fits[sensor.name]
        return min((fit[1] / fit[0] for fit in by_ring.values() if fit[0] > 0), default=1.0)

    def _how_doubtful(self, share: float) -> float:
        """
        How much to doubt the body, 0 to 1.

        1 while lost; while suspect and not yet searched, as far as the worst ring's share has
        sunk; else 0.
        """
        if self._watch.lost:
            return 1.0
        if self._watch.since is None or self._watch.backoff > 1.0:
            return 0.0
        return max(1.0 - share / self._settings.suspect_share, 0.0)

    def _search(self) -> bool:
        """
        Try the shapes that a search finds, and take one that fits better than the present body.

        True when the body that results is to be believed: no other one fits as well.
        """
        window = self._window
        rows = window.newest_rows(self._tof, SEARCH_INTERVALS)
        if not rows:
            return False
        past = window.snapshot() if self.acquired else None
        window.keep_newest(SEARCH_INTERVALS)
        present = window.columns[-1]
        mine = self._refine()
        tries = [mine]
        for strain in self._shapes.find(present.T[0], Snapshot.of(rows)):
            window.place(place(window.grid, present, present.T[0], strain))
            tries.append(self._refine())
        slack = 0.0 if past is None else SHARE_SLACK  # a body that was tracked is not lightly left
        better = [one for one in tries if self._beats(one, mine, slack)]
        chosen = min(better, key=_cost, default=mine)
        if past is not None and chosen is mine:
            window.restore(past)  # nothing better was found: what was known before still is
        else:
            window.set_columns(chosen.columns)
            self._refine()
        self.acquired = True
        return not any(self._rivals(one, chosen) for one in tries)

    def _beats(self, other: Try, mine: Try, slack: float) -> bool:
        """
        Whether another body is better: it costs clearly less, and more fits it, by over `slack`.

        Cost alone misleads where the map lacks something: zones without a match near the right
        body cost more than zones that lie a little off in a wrong one, where no sensor fits
        wholly.
        """
        cheaper = other.cost * (1.0 + self._settings.margin) < mine.cost
        return cheaper and other.share > mine.share + slack and other.whole >= mine.whole

    def _rivals(self, other: Try, chosen: Try) -> bool:
        """Whether another body, somewhere else, explains about as much."""
        rings = self._window.grid.ring_nodes
        here, there = (one.columns[-1].T[rings, :3, 3] for one in (chosen, other))
        return (
            np.linalg.norm(here - there, axis=1).max() >= AMBIGUOUS
            and other.cost <= chosen.cost * (1.0 + self._settings.margin)
            and other.share > chosen.share - SHARE_SLACK
            and other.whole >= chosen.whole
        )

    def _refine(self) -> Try:
        """Solve the window from where it is."""
        self.acquire()
        columns = [self._window.column(k) for k in range(len(self._window.columns))]
        shares = self._window.fit().shares
        tof = np.array([shares[name] for name in self._tof.weights if name in shares])
        whole = int(np.sum(tof >= self._settings.suspect_share))
        return Try(self._window.measurement_cost(), float(np.mean(tof)), whole, columns)


def _cost(one: Try) -> float:
    return one.cost


class ShapeSearch:
    """Beam search over bent shapes for the ones that a snapshot fits."""

    def __init__(self, grid: Grid, tof: TofFactor, settings: RecoverySettings, priors: Priors):
        self.grid, self.settings, self.rest = grid, settings, priors.rest
        self.options = tof.settings.tof
        self._tof, self._thinned = tof, None
        count = int(round(settings.max_curvature / settings.curvature_step))
        steps = settings.curvature_step * np.arange(-count, count + 1)
        self.curvatures = np.stack(np.meshgrid(steps, steps, indexing='ij'), -1).reshape(-1, 2)
        self.curvatures = self.curvatures[
            np.hypot(*self.curvatures.T) <= settings.max_curvature + 1e-9
        ]
        self._bending_psd = float(np.mean(priors.strain_psd[~grid.steps, 4:]))

    @property
    def _map(self) -> tuple:
        """Return the thinned map, made at the first search."""
        if self._thinned is None:
            self._thinned = thinned(self._tof, COARSE_SPACING)
        return self._thinned

    def find(self, T_map_base: np.ndarray, snapshot: Snapshot) -> list[np.ndarray]:
        """Strain (N, 6) at the nodes of the best shapes, best first."""
        rings = self.grid.ring_nodes
        T, cost = T_map_base[None], np.zeros(1)
        bends = np.zeros((1, 0, 2))
        for ring in range(1, len(rings)):
            length = self.grid.s[rings[ring]] - self.grid.s[rings[ring - 1]]
            T, cost, bends = self._extend(T, cost, bends, length, rings[ring], snapshot)
        return [self._strain_at_nodes(bend) for bend in bends[: self.settings.refined]]

    def _extend(self, T, cost, bends, length, node, snapshot):
        parents, grid = len(T), len(self.curvatures)
        strain = np.tile(self.rest, (grid, 1))
        strain[:, 4:] += self.curvatures
        ends = (T[:, None] @ lie.exp(length * strain)[None]).reshape(-1, 4, 4)
        frames = np.flatnonzero(snapshot.nodes == node)
        scores = self._score(ends, snapshot, frames) if len(frames) else np.zeros(len(ends))
        before = bends[:, -1] if bends.shape[1] else np.zeros((parents, 2))
        change = np.sum((self.curvatures[None] - before[:, None]) ** 2, axis=2) / (
            self._bending_psd * length
        )
        total = (cost[:, None] + 0.5 * change).ravel() + scores
        chosen = self._different(total, ends)
        grown = np.concatenate(
            [bends[chosen // grid], self.curvatures[chosen % grid][:, None]], axis=1
        )
        return ends[chosen], total[chosen], grown

    def _score(self, T: np.ndarray, snapshot: Snapshot, frames: np.ndarray) -> np.ndarray:
        return _score(
            T,
            snapshot.q[frames],
            snapshot.rays[frames],
            snapshot.variance[frames],
            *self._map,
            self.settings.score_floor**2,
            self.options.acquisition_cauchy,
            self.settings.score_gate,
            self.options.min_cosine,
        )

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
        s = self.grid.s[self.grid.ring_nodes]
        strain = np.tile(self.rest, (self.grid.nodes, 1))
        for i in range(2):
            strain[:, 4 + i] += np.interp(self.grid.s, 0.5 * (s[1:] + s[:-1]), bends[:, i])
        return strain


def thinned(tof: TofFactor, spacing: float) -> tuple:
    """
    Thin the map's arrays for the kernels.

    One point for each cell of `spacing` and each octant of the normal, so that both sides of a
    thin blade stay.
    """
    from continuum_loc.mapping.voxel_index import VoxelIndex

    _, surface, variance = tof.map_arrays
    points, normals = surface[:, :3], surface[:, 3:6]
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    octants = (normals > 0.0) @ np.array([1, 2, 4])
    keys = np.ravel_multi_index((*cells.T, octants), (*(cells.max(axis=0) + 1), 8))
    order = np.argsort(keys, kind='stable')
    kept = order[np.flatnonzero(np.diff(keys[order], prepend=-1))]
    index = VoxelIndex(points[kept], normals[kept])
    return index.arrays, surface[kept], variance


def place(grid: Grid, column: Column, T_map_base: np.ndarray, strain: np.ndarray) -> Column:
    """Place the column motionless in another shape; its biases stay."""
    return Column(
        column.time,
        shape_from_strain(T_map_base, grid.s, strain),
        strain.copy(),
        np.zeros_like(strain),
        column.bias.copy(),
    )


@njit(cache=True)
def _score(
    T,
    q,
    rays,
    variance,
    arrays,
    surface,
    map_variance,
    floor2,
    cauchy,
    gate,
    min_cosine,
):
    """Robust cost (M,) of the frames at each pose T (M, 4, 4)."""
    H, g, fit, hits = np.empty((6, 6)), np.empty(6), np.zeros(2), np.empty(q.shape[1], np.int64)
    nowhere = np.full((q.shape[1], 4), np.nan)
    out = np.zeros(T.shape[0])
    for m in range(T.shape[0]):
        for f in range(q.shape[0]):
            places = nowhere.copy()
            associate(
                T[m], q[f], rays[f], variance[f], arrays, gate, min_cosine, 0.0, hits, places
            )
            cost, _, _ = frame_information(
                T[m],
                q[f],
                rays[f],
                variance[f],
                hits,
                1.0,
                surface,
                map_variance,
                floor2,
                0.0,
                cauchy,
                gate,
                H,
                g,
                fit,
            )
            out[m] += cost
    return out
