"""
Lost and found: noticing that the body is in a wrong minimum, and finding it again.

A wrong minimum shows in the share of ToF zones that fit the map. A low share alone is no proof
(the scene may differ from the map), so a suspicion leads to a search of all shapes: where nothing
fits better, the filter was right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from continuum_loc.estimate import Status
from continuum_loc.estimator.factors import Factor, TofFactor
from continuum_loc.estimator.fit import fit_of, measurement_cost, newest_fits
from continuum_loc.estimator.health import Health
from continuum_loc.estimator.search import ShapeSearch, Snapshot
from continuum_loc.estimator.settings import RecoverySettings
from continuum_loc.estimator.solver import from_a_guess, track
from continuum_loc.estimator.state import Column, column_at_rest
from continuum_loc.estimator.window import Window
from continuum_loc.robot import RobotDescription
import numpy as np

SEARCH_INTERVALS = 2  # the newest, whose measurements decide between bodies
SHARE_SLACK = 0.02  # of fitting zones, by which two bodies explain about as much
AMBIGUOUS = 0.03  # [m] bodies closer than this at every ring are the same one
BACKOFF_LIMIT = 8.0  # [s] longest time between two searches of a body that stays suspect


@dataclass(slots=True)
class Watch:
    """Whether the body is to be believed: suspicion, and when to search next [s of data]."""

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
class Try:
    """
    A body that was tried.

    cost: of its measurements; share: mean share of zones that fit; whole: number of sensors of
    which (nearly) all do.
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
        factors: Sequence[Factor],
        health: Health,
        settings: RecoverySettings,
    ):
        self.acquired = False
        self._robot, self._window, self._factors, self._settings = robot, window, factors, settings
        self._health, self._watch = health, Watch(settings)
        self._doubt = 0.0
        self._tof = next((one for one in factors if isinstance(one, TofFactor)), None)
        self._shapes = (
            ShapeSearch(window.grid, self._tof, settings, window.priors) if self._tof else None
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
        """Solve the window from a guess, matching widely: (iterations, whether it converged)."""
        return from_a_guess(self._window, self._factors)

    def look_after(self, time: float, converged: bool) -> None:
        """Notice a wrong minimum by the worst ring's fitting share, and look for a better body."""
        self._health.look(time, body_believed=False, body_doubted=self._watch.since is not None)
        if self._tof is None or not self._settings.enabled:
            self.acquired = self.acquired or converged
            return
        share = self.worst_share()
        fitting = share >= self._settings.suspect_share
        self.acquired = self.acquired or (converged and fitting)
        due = self._watch.update(time, share)
        if due or (not fitting and not self.acquired and time >= self._watch.next_search):
            confirmed = self._search()
            self._watch.searched(time, confirmed)
            if confirmed:
                self._health.look(time, body_believed=True, body_doubted=True)
        self._doubt = self._how_doubtful(self.worst_share())

    def worst_share(self) -> float:
        """
        Least share of fitting zones over the rings, in the newest interval with ToF frames.

        Sensors that are themselves suspect do not count.
        """
        fits = newest_fits(self._window.intervals, self._tof)
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
        newest = window.intervals[-SEARCH_INTERVALS:]
        rows = [row for interval in newest for row in interval.rows(self._tof)]
        if not rows:
            return False
        past = window.snapshot() if self.acquired else None
        window.wandered = self.acquired
        window.keep_newest(SEARCH_INTERVALS)
        present = window.columns[-1]
        mine = self._refine()
        tries = [mine]
        for strain in self._shapes.find(present.T[0], Snapshot.of(rows)):
            window.place(column_at_rest(window.grid, present.T[0], strain, *_known(present)))
            tries.append(self._refine())
        slack = 0.0 if past is None else SHARE_SLACK  # a body that was tracked is not lightly left
        better = [one for one in tries if self._beats(one, mine, slack)]
        chosen = min(better, key=_cost, default=mine)
        if past is not None and chosen is mine:
            window.restore(past)  # nothing better was found: what was known before still is
            track(window)
        else:
            window.set_columns(chosen.columns)
            self._refine()
        self.acquired = True
        return not any(self._rivals(one, chosen) for one in tries)

    def locate(self, bodies: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[bool, np.ndarray]:
        """
        Try bodies, each a base (4, 4) and strain (N, 6), and take the best one.

        Returns whether it is to be believed, as it fits and no other one does as well; and the
        places (H, 4, 4) of the base that were tried, best first.
        """
        window = self._window
        window.wandered = True
        window.keep_newest(SEARCH_INTERVALS)
        present, tries = window.columns[-1], []
        for T_map_base, strain in bodies:
            window.place(column_at_rest(window.grid, T_map_base, strain, *_known(present)))
            tries.append(self._refine())
        if not tries:
            return False, np.empty((0, 4, 4))
        tries.sort(key=_cost)
        chosen = tries[0]
        window.set_columns(chosen.columns)
        self._refine()
        alone = not any(self._rivals(one, chosen) for one in tries[1:])
        self.acquired = alone and self.worst_share() >= self._settings.suspect_share
        return self.acquired, np.array([one.columns[-1].T[0] for one in tries])

    def lose(self) -> None:
        """Say that the body is lost, until it is found again."""
        self._watch.lost, self.acquired = True, False

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
        window = self._window
        columns = [window.column(k) for k in range(len(window.columns))]
        shares = fit_of(window.intervals).shares
        tof = np.array([shares[name] for name in self._tof.sensors if name in shares])
        whole = int(np.sum(tof >= self._settings.suspect_share))
        return Try(measurement_cost(window.intervals), float(np.mean(tof)), whole, columns)


def _cost(one: Try) -> float:
    return one.cost


def _known(column: Column) -> tuple[float, np.ndarray, np.ndarray]:
    """Return what another body would share with a column: time, biases and the base's frame."""
    return column.time, column.bias, column.T_map_frame
