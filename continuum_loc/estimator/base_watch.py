"""
Whether the base is where it is said to be, by the description or by what measures it.

The prior of a fixed base and its encoder let go where everything else has the base far from them
(`priors`, `factors/pose.py`), and a measured base's frame moves away from where its errors could
be; so the estimate itself shows how far off they are.
"""

from __future__ import annotations

from collections.abc import Callable

from continuum_loc import lie
from continuum_loc.estimator.factors import Setup
from continuum_loc.estimator.tolerance import BASE
from continuum_loc.estimator.window import Window
from continuum_loc.measurements import EncoderSample, Measurement
import numpy as np

FAR_SQUARED = 27.9  # chi-squared of six degrees of freedom at 1e-4
FAR_ALONG = 15.1  # of one
PATIENCE = 0.15  # [s] that it must last
INSERTION = 'insertion'


class BaseWatch:
    """Compares the base of the window with what is said of it."""

    def __init__(self, setup: Setup, window: Window):
        base = setup.robot.base
        self._base, self._window, self._grid = base, window, setup.grid
        self._variance = np.square(base.sigma)
        if base.mode == 'fixed':
            estimated = setup.settings.calibration.enabled
            self._variance += np.square(setup.robot.tolerances.base_sigma if estimated else BASE)
        self.spread: Callable[[np.ndarray], np.ndarray] | None = None
        self._stays = base.measurement.frame == 'map' and base.measurement.drift == 0.0
        self._travel: tuple[float, float] | None = None  # [s], [m]
        self._since: dict[str, float] = {}

    def note(self, measurement: Measurement, time: float) -> None:
        """Keep the newest travel of a base whose encoder tells it."""
        if isinstance(measurement, EncoderSample) and INSERTION in measurement.names:
            travel = float(measurement.position[measurement.names.index(INSERTION)])
            self._travel = (time, travel)

    def causes(self, time: float) -> dict[str, str]:
        """Say how base and encoder are off at `time` [s], once that has lasted; else nothing."""
        found = {'base': '', INSERTION: ''}
        if self._base.mode == 'fixed':
            found |= self._from_description()
        elif self._base.mode == 'measured' and self._stays:
            found['base'] = self._off(*self._from_measurement(), 'is not where it is told to be')
        for name, said in found.items():
            if not said:
                self._since.pop(name, None)
            elif time - self._since.setdefault(name, time) < PATIENCE:
                found[name] = ''
        return found

    def _from_description(self) -> dict[str, str]:
        """Compare with the description across the axis, and with the encoder along it."""
        T, J = self._window.column(-1).T[0], np.zeros((6, self._grid.dim))
        J[:, :6] = np.eye(6)
        mode = self._base.insertion.mode
        said = {}
        if mode == 'measured' and self._travel is not None:
            said[INSERTION] = self._off_along(J[:1])
        e = lie.log(lie.inverse(self._base.T_map_base) @ T)
        if mode != 'fixed':
            e[0], J[0] = 0.0, 0.0
        return said | {'base': self._off(e, J, 'is not where the description has it')}

    def _off_along(self, J: np.ndarray) -> str:
        """Compare the travel with the newest that the encoder told, at its time."""
        time, travel = self._travel
        first, last = self._window.columns[0].time, self._window.columns[-1].time
        at = self._window.body(min(max(time, first), last)).T[0]
        e = (lie.inverse(self._base.T_map_base) @ at)[0, 3] - travel
        variance = self._variance[0] + self._base.insertion.sigma**2
        if e * e / variance < FAR_ALONG or e * e / (variance + self._own(J)[0, 0]) < FAR_ALONG:
            return ''
        return f'contradicts the rest ({1e3 * abs(e):.0f} mm off)'

    def _from_measurement(self) -> tuple[np.ndarray, np.ndarray]:
        """Error (6,) of the frame, as the base sees it, and its Jacobian (6, D)."""
        column = self._window.column(-1)
        seen = lie.adjoint(lie.inverse(column.T[0]) @ column.T_map_frame[0])
        J = np.zeros((6, self._grid.dim))
        J[:, self._grid.frame_rows] = seen
        return seen @ lie.log(column.T_map_frame[0]), J

    def _own(self, J: np.ndarray) -> np.ndarray:
        """Covariance of what J (m, D) says of the newest column."""
        last = len(self._window.columns) - 1
        return self._window.chain.covariance(last - 1, np.zeros(J.shape), J)

    def _lasting(self) -> np.ndarray:
        """Covariance (6, 6) that estimated constants of the robot leave on the base."""
        return np.zeros((6, 6)) if self.spread is None else self.spread(np.array([0]))[0]

    def _off(self, e: np.ndarray, J: np.ndarray, words: str) -> str:
        if e @ (e / self._variance) < FAR_SQUARED:
            return ''
        spread = np.diag(self._variance) + self._own(J) + self._lasting()
        if e @ np.linalg.solve(spread, e) < FAR_SQUARED:
            return ''
        shift, turn = np.linalg.norm(e[:3]), np.degrees(np.linalg.norm(e[3:]))
        return f'{words} ({1e3 * shift:.0f} mm, {turn:.1f} deg off)'
