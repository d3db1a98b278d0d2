"""
Whether the base is where it is said to be, by the description or by what measures it.

The prior of a fixed base lets go where everything else has the base far from it (`priors`), and a
measured base's frame moves away from where its errors could be; so the estimate itself shows how
far off they are.
"""

from __future__ import annotations

from continuum_loc import lie
from continuum_loc.estimator.factors import Setup
from continuum_loc.estimator.window import Window
import numpy as np

FAR_SQUARED = 27.9  # chi-squared of six degrees of freedom at 1e-4
PATIENCE = 0.2  # [s] that it must last


class BaseWatch:
    """Compares the base of the window with what is said of it."""

    def __init__(self, setup: Setup, window: Window):
        base = setup.robot.base
        self._mode, self._window, self._grid = base.mode, window, setup.grid
        sigma = [base.sigma_position] * 3 + [np.radians(base.sigma_rotation_deg)] * 3
        self._variance = np.square(sigma)
        self._inserted = base.insertion.mode != 'fixed'
        self._stays = base.measurement.frame == 'map' and base.measurement.drift == 0.0
        self._T_map_base = base.T_map_base
        self._since: float | None = None

    def cause(self, time: float) -> str:
        """Say how the base is off at `time` [s], once that has lasted; empty where it is not."""
        said = ''
        if self._mode == 'fixed':
            said = self._off(*self._from_description(), 'is not where the description has it')
        elif self._mode == 'measured' and self._stays:
            said = self._off(*self._from_measurement(), 'is not where it is told to be')
        if not said:
            self._since = None
            return ''
        self._since = time if self._since is None else self._since
        return said if time - self._since >= PATIENCE else ''

    def _from_description(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose error (6,) of the first node, and its Jacobian (6, D) in the newest column."""
        T = self._window.column(-1).T[0]
        e, J = lie.log(lie.inverse(self._T_map_base) @ T), np.zeros((6, self._grid.dim))
        J[:, :6] = np.eye(6)
        if self._inserted:  # along its axis an encoder tells, or nobody
            e[0], J[0] = 0.0, 0.0
        return e, J

    def _from_measurement(self) -> tuple[np.ndarray, np.ndarray]:
        """Error (6,) of the frame, as the base sees it, and its Jacobian (6, D)."""
        column = self._window.column(-1)
        seen = lie.adjoint(lie.inverse(column.T[0]) @ column.T_map_frame[0])
        J = np.zeros((6, self._grid.dim))
        J[:, self._grid.frame_rows] = seen
        return seen @ lie.log(column.T_map_frame[0]), J

    def _off(self, e: np.ndarray, J: np.ndarray, words: str) -> str:
        if e @ (e / self._variance) < FAR_SQUARED:
            return ''
        last, D = len(self._window.columns) - 1, self._grid.dim
        own = self._window.chain.covariance(last - 1, np.zeros((6, D)), J)
        spread = np.diag(self._variance) + own
        if e @ np.linalg.solve(spread, e) < FAR_SQUARED:
            return ''
        shift, turn = np.linalg.norm(e[:3]), np.degrees(np.linalg.norm(e[3:]))
        return f'{words} ({1e3 * shift:.0f} mm, {turn:.1f} deg off)'
