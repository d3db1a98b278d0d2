"""
What the robot departs from its description by, found out while it moves.

The constants of `parameters` are in every measurement, and what a window says of them would be
lost when its oldest column is marginalised. So the border of the chain (`border`) is carried on as
the chain is: with theta counted from what measurements are taken for now, the past is a quadratic
of the oldest column and theta,

    C' = C_b - Y^T Z,   H' = H + H_k - Z^T Z,   g' = g + g_k - Z^T y,   Z = L^-1 (C + C_a),

whose L, Y, y are the chain's. Eliminating the column leaves theta's own mean and covariance.

Now and then measurements are taken for what this says (`due`, `take`); what is left unknown is in
the covariance of the body, by the sensitivity of the body to the constants (`spread`).
"""

from __future__ import annotations

from continuum_loc.estimator.border import Border
from continuum_loc.estimator.chain import Chain
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.normal import Normal, symmetric
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.settings import CalibrationSettings
from continuum_loc.estimator.state import Column, NODE_DIM
from continuum_loc.estimator.window import Window
import numpy as np
from scipy.linalg import cho_factor, cho_solve

TINY = 1e-12
NOTABLE = 0.25  # of its standard deviation, by which a constant changes before that is acted on


class Calibrator:
    """
    Estimates the constants of one robot beside its motion.

    parameters: with the robot as measurements are taken now; theta: (P,) how far that is from the
    description; covariance: (P, P) of what is left unknown.
    """

    def __init__(self, parameters: Parameters, window: Window, settings: CalibrationSettings):
        self.parameters, self._window, self._settings = parameters, window, settings
        self.theta = np.zeros(parameters.size)
        self.covariance = np.diag(np.square(parameters.sigma))
        self._floor = np.square(float(settings.online) * settings.least * parameters.sigma)
        self._known = np.diag(parameters.sigma**-2.0), np.zeros(parameters.size)
        self._sensitivity: np.ndarray | None = None
        self._lateness = {name: parameters.lateness(name) for name in parameters.boards}
        self._apart = np.eye(parameters.size)  # theta with its clocks counted from their mean
        self._apart[np.ix_(parameters.clocks, parameters.clocks)] -= 1.0 / max(
            len(parameters.clocks), 1
        )
        self._timing = np.flatnonzero(np.any(list(self._lateness.values()), axis=0))
        self._seen, self._next = 0, settings.period
        window.on_forgetting = self._carry_on

    def _carry_on(self, interval: Interval, a: Column, b: Column, chain: Chain) -> None:
        """Take what an interval says of the constants along, before its column is forgotten."""
        dim = self._window.grid.dim
        past = chain.border or self._begin(a)
        border = interval.bordered(self._window.priors, a, b, self.parameters)
        C, Z = chain.pass_on(past.C + border.C[:dim], border.C[dim:])
        chain.border = Border(C, past.H + border.H - Z.T @ Z, past.g + border.g - chain.oldest @ Z)

    def _begin(self, column: Column) -> Border:
        """Start from a column of which nothing but its own prior is known."""
        H, g = self._known
        border = Border(np.zeros((self._window.grid.dim, len(g))), H.copy(), g.copy())
        self._window.priors.bordered(border, column, 1.0, self.parameters)
        return border

    def due(self, time: float) -> np.ndarray | None:
        """
        Say by how much (P,) to change what measurements are taken for at `time` [s].

        Where the equations are singular, nothing is said.
        """
        chain = self._window.chain
        if chain.border is None or time < self._next:
            return None
        try:
            return self._look(time)
        except np.linalg.LinAlgError:
            return None

    def _look(self, time: float) -> np.ndarray | None:
        chain = self._window.chain
        self._next = time + self._settings.period
        share = self._settings.period / self._settings.drift
        self._wander(np.arange(len(self.theta)), share * self.parameters.sigma**2)
        past, start = chain.border, chain.marginals[0]
        W = cho_solve(cho_factor(symmetric(start.H)), past.C)
        H, g = past.H - past.C.T @ W, past.g - start.g @ W
        self._sensitivity = W
        if not self._settings.online:
            return None
        covariance = np.linalg.inv(H)
        if np.min(np.diag(covariance)) <= 0.0:
            return None
        self._known, self.covariance = (H, g), covariance
        step = self.parameters.centred(self.theta, -self.covariance @ g)
        notable = np.abs(step) > NOTABLE * np.sqrt(np.diag(self.covariance))
        return step if notable.any() else None

    def _wander(self, at: np.ndarray, variance: np.ndarray) -> None:
        """
        Let the constants `at` (m,) have wandered with a variance (m,).

        With noise of covariance Q the past [x; theta] has, for theta after it, the information
        [Lambda - C M C^T, C - C M H; H - H M H] where M = (Q^-1 + H)^-1 of those that wandered.
        """
        chain = self._window.chain
        (C, H, g), start = chain.border, chain.marginals[0]
        M = np.linalg.inv(H[np.ix_(at, at)] + np.diag(1.0 / variance))
        MH, MC, Mg = M @ H[at], M @ C[:, at].T, M @ g[at]
        chain.marginals[0] = Normal(np.triu(start.H - C[:, at] @ MC), start.g - C[:, at] @ Mg)
        chain.border = Border(C - C[:, at] @ MH, H - H[:, at] @ MH, g - H[:, at] @ Mg)
        self._window.intervals[0].changed = True

    def take(self, step: np.ndarray) -> Parameters:
        """Count the constants from where they now are; returns their parameters there."""
        # What was linearised about other clocks is worth less: the body turns meanwhile.
        self._wander(self._timing, np.square(step[self._timing]) + TINY)
        chain = self._window.chain
        chain.border.g[:] += chain.border.H @ step
        chain.marginals[0].g[:] += chain.border.C @ step
        H, g = self._known
        self._known = H, g + H @ step
        self.theta = self.theta + step
        self.parameters = self.parameters.at(step)
        return self.parameters

    def late(self, least: float, sigmas: float) -> dict[str, float]:
        """Name sensors whose clocks are off by `least` [s] and by so many standard deviations."""
        found = {}
        for name, by in self._lateness.items():
            apart = self._apart @ by
            offset = float(by @ self.theta)
            sigma = float(np.sqrt(apart @ self.covariance @ apart))
            if abs(offset) > least and abs(offset) > sigmas * sigma:
                found[name] = offset
        return found

    def spread(self, nodes: np.ndarray) -> np.ndarray:
        """(m, 6, 6) covariance that the constants leave on the poses of nodes (m,)."""
        if self._window.chain.border is None and self._seen != len(self._window.intervals):
            self._seen = len(self._window.intervals)
            self._sensitivity = self._first_sensitivity()
        S = self._sensitivity[NODE_DIM * nodes[:, None] + np.arange(6)]
        covariance = self.covariance + np.diag(self._floor)
        return S @ covariance @ S.transpose(0, 2, 1)

    def _first_sensitivity(self) -> np.ndarray:
        """Sensitivity (D, P) of the newest column but one, before any column was marginalised."""
        chain = self._window.chain
        return chain.unwhiten(chain.whiten(self._window.border(self.parameters).C))[-2]
