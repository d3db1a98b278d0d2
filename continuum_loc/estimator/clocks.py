"""
Clock offsets: whether a sensor's stamps lie where its measurements do.

Were a sensor's true time stamp + tau, its residuals would be those of the body at that time. To
first order tau is one more unknown of the window's least squares, with gradient g, information h
and coupling c to the columns' offsets x. Eliminating these leaves

    information  I = h - c^T Lambda^-1 c,    tau = -(g + c^T x) / I,    variance 1 / I,

since the window is at its minimum. The test costs one forward substitution with the factors that
the chain keeps; sensors that share a clock are tested together by adding their g, h and c.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.window import Window
import numpy as np

MOST_OFFSET = 0.2  # [s] beyond a knot or so, residuals that are linear in time say nothing
LEAST_INFORMATION = 1.0  # [1/s^2]: a sigma of a second says nothing


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """What true time less stamp is for some sensors [s], and its standard deviation [s]."""

    sensors: tuple[str, ...]
    offset: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """How many standard deviations the offset is from none."""
        return abs(self.offset) / self.sigma


@dataclass(frozen=True, slots=True, eq=False)
class ClockEvidence:
    """
    What a window says of its sensors' clocks.

    names (S,); gradient g + c^T x (S,); own information h (S,); taken (S, S), c^T Lambda^-1 c;
    spread (S,), variance of what is left of the residuals over that of the noise.
    """

    names: list[str]
    gradient: np.ndarray
    own: np.ndarray
    taken: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, window: Window, factors: Sequence[Factor]) -> ClockEvidence:
        """Gather it from the window's intervals and its chain."""
        names, g, h, C, spread = _gather(window, factors)
        gradient = g + np.einsum('kds,kd->s', C, np.array(window.offsets))
        return cls(names, gradient, h, window.chain.quadratic(C), spread)

    def offsets(
        self, groups: Sequence[tuple[str, ...]], least: float, sigmas: float
    ) -> list[ClockOffset]:
        """
        Find the groups whose clocks are off by at least `least` [s] and `sigmas` sigmas.

        One wrong clock drags the body along, so that its neighbours' seem wrong too: the most
        certain offset is taken first, and eliminated before the others are looked at again. One
        that is certain only because its residuals exceed their noise, or larger than any that the
        first order describes, is eliminated and not told.
        """
        g, information = self.gradient, np.diag(self.own) - self.taken
        found: list[ClockOffset] = []
        left = list(groups)
        while left:
            best = max((self._solve(one, g, information) for one in left), key=_sigmas)
            if best.sigmas < sigmas or abs(best.offset) < least:
                break
            member = self._members(best.sensors)
            inflation = np.sqrt(max(member @ self.spread / member.sum(), 1.0))
            if best.sigmas >= sigmas * inflation and abs(best.offset) <= MOST_OFFSET:
                found.append(replace(best, sigma=best.sigma * inflation))
            coupled = information @ member
            g = g + coupled * best.offset
            information = information - np.outer(coupled, coupled) * best.sigma**2
            left.remove(best.sensors)
        return found

    def outside(self, group: tuple[str, ...], weight: float) -> ClockOffset:
        """
        Estimate the offset of sensors that count with a small `weight`, so that others say where.

        At full weight their gradient is g / w and their information h / w; the body, which does
        not follow them, adds its own uncertainty to that of the residuals.
        """
        member = self._members(group)
        own, taken = member @ self.own / weight, member @ self.taken @ member / weight**2
        if own < LEAST_INFORMATION:
            return ClockOffset(group, 0.0, np.inf)
        offset = -(member @ self.gradient) / weight / own
        return ClockOffset(group, float(offset), float(np.sqrt(own + taken) / own))

    def _members(self, group: tuple[str, ...]) -> np.ndarray:
        return np.array([name in group for name in self.names], float)

    def _solve(
        self, group: tuple[str, ...], g: np.ndarray, information: np.ndarray
    ) -> ClockOffset:
        """Solve for one group's offset as if it were the only one."""
        member = self._members(group)
        total = member @ information @ member
        if total < LEAST_INFORMATION:
            return ClockOffset(group, 0.0, np.inf)
        return ClockOffset(group, float(-member @ g / total), float(total**-0.5))


def _sigmas(clock: ClockOffset) -> float:
    return clock.sigmas


def _gather(window: Window, factors: Sequence[Factor]):
    """Sum g, h (S,) and c (K, D, S) over the window by sensor, and the mean spread (S,)."""
    names: dict[str, int] = {}
    parts = []
    for k, interval in enumerate(window.intervals):
        for factor in factors:
            scores = interval.clock_scores(factor, window.columns[k], window.columns[k + 1])
            if scores is not None:
                at = [names.setdefault(name, len(names)) for name in factor.sensors]
                parts.append((k, at, scores))
    columns, dim, sensors = len(window.columns), window.grid.dim, len(names)
    g, h, C = np.zeros(sensors), np.zeros(sensors), np.zeros((columns, dim, sensors))
    spread, count = np.zeros(sensors), np.zeros(sensors)
    for k, at, scores in parts:
        g[at] += scores.gradient
        h[at] += scores.information
        C[k][:, at] += scores.coupling[:dim]
        C[k + 1][:, at] += scores.coupling[dim:]
        spread[at] += scores.spread
        count[at] += 1.0
    return list(names), g, h, C, spread / np.maximum(count, 1.0)
