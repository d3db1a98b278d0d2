"""
The start of a base that may be anywhere in a region: search, try, confirm, and only then tell.

Also after a kidnap. Until a body is confirmed nothing is put out but hypotheses: places that fit
the newest frames, best first. Where two fit equally well, it waits for the robot to move on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from continuum_loc.estimator.factors import Factor, Guess, Setup, TofFactor
from continuum_loc.estimator.locate import BaseSearch, Region
from continuum_loc.estimator.search import Snapshot
from continuum_loc.estimator.state import shape_from_strain
from continuum_loc.estimator.window import Window
from continuum_loc.measurements import ImuSample, Measurement
import numpy as np

FIRST = 0.3  # [s] of data before the first search
AGAIN = 0.5  # [s] between two searches
CONFIRM = 0.4  # [s] that a body has to fit before it is told
KIDNAPPED, PATIENCE = 0.6, 0.12  # share of fitting zones below which, for so long [s], it is lost
ACCELERATIONS = 50  # samples of each IMU whose mean says what is up
STEADY = 1.0  # [m/s^2] the mean may be from gravity
GRAVITY = 9.81

Body = tuple[np.ndarray, np.ndarray]  # T_map_base (4, 4) and strain (N, 6)


class Start:
    """
    Whether the base has to be found, and where it may be.

    pending: nothing may be told yet. hypotheses: (H, 4, 4) places of the base, best first.
    """

    def __init__(self, setup: Setup, window: Window, factors: Sequence[Factor]):
        base = setup.robot.base
        self._setup, self._window, self._factors = setup, window, factors
        self._tof = next((one for one in factors if isinstance(one, TofFactor)), None)
        reach, turn = base.region
        self.wanted = base.mode == 'free' and reach > 0.0 and self._tof is not None
        self._region = Region(base.T_map_base, reach, np.radians(turn))
        self.pending = self.wanted
        self.hypotheses = np.empty((0, 4, 4))
        self._next, self._until, self._since = FIRST, None, None
        self._forces: dict[str, deque[np.ndarray]] = {}
        up = np.array(setup.settings.gravity.up)
        self._search = (
            BaseSearch(setup.grid, setup.distances, up / np.linalg.norm(up))
            if self.wanted
            else None
        )

    def note(self, measurement: Measurement) -> None:
        """Keep what accelerometers say."""
        if self.wanted and isinstance(measurement, ImuSample):
            force = measurement.linear_acceleration
            if np.isfinite(force).all():
                kept = self._forces.setdefault(measurement.sensor, deque(maxlen=ACCELERATIONS))
                kept.append(force)

    @property
    def astray(self) -> bool:
        """Whether the body fits so badly just now that it may have been carried off."""
        return self._since is not None

    def due(self, time: float) -> bool:
        """Whether it is time for a search."""
        return self.pending and self._until is None and time >= self._next

    def bodies(self) -> list[Body]:
        """Search: places of the base with the shape that the newest samples tell, best first."""
        rows = [row for one in self._window.intervals[-2:] for row in one.rows(self._tof)]
        if len({row.sensor for row in rows}) < 0.5 * len(self._tof.sensors):
            return []
        strain = self._shape()
        found = self._search.find(Snapshot.of(rows), strain, self._up(strain), self._region)
        return [(one.T_map_base, strain) for one in found]

    def tried(self, time: float, found: bool, hypotheses: np.ndarray) -> None:
        """Note what came of a search; a body that was found has to be confirmed."""
        self.hypotheses = hypotheses
        self._next = time + AGAIN
        self._until = time + CONFIRM if found else None

    def watch(self, time: float, share: float) -> None:
        """Note the share of fitting zones: confirm a body, or give one up that was kidnapped."""
        if not self.wanted:
            return
        low = share < KIDNAPPED
        self._since = None if not low else time if self._since is None else self._since
        if self._until is not None:
            if low:
                self._until = None  # it was wrong: search again
            elif time >= self._until:
                self.pending, self._until = False, None
                self.hypotheses = np.empty((0, 4, 4))
        elif not self.pending and low and time - self._since >= PATIENCE:
            self.pending, self._next = True, time

    def _shape(self) -> np.ndarray:
        """Strain (N, 6) of the newest strain sample; straight where there is none."""
        strain = np.tile(self._window.priors.rest, (self._setup.grid.nodes, 1))
        guess = Guess(np.eye(4), strain, np.empty((0, 4, 4)))
        for factor in self._factors:
            if factor.name == 'strain':
                rows = [row for one in self._window.intervals[-2:] for row in one.rows(factor)]
                for row in rows[-1:]:
                    factor.guess(row, guess)
        return guess.strain

    def _up(self, strain: np.ndarray) -> np.ndarray | None:
        """Direction (3,) against gravity in the base's frame; None where nobody rests."""
        robot, grid = self._setup.robot, self._setup.grid
        T_base_node = shape_from_strain(np.eye(4), grid.s, strain)
        found = []
        for imu in robot.imu:
            force = np.mean(self._forces.get(imu.name, [np.zeros(3)]), axis=0)
            if abs(np.linalg.norm(force) - GRAVITY) < STEADY:
                node = grid.node_at(robot.sensor_arclength(imu.name))
                found.append(T_base_node[node, :3, :3] @ imu.mount.T_ring_sensor[:3, :3] @ force)
        if not found:
            return None
        mean = np.mean(found, axis=0)
        return mean / np.linalg.norm(mean)
