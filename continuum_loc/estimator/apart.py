"""
The body without what some sensors told.

A sensor of great weight pulls the body to itself and then fits. So whoever is judged is first
taken out of the window's normal equations, which are solved once more where they are: no
measurement is matched or linearised anew.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from continuum_loc.errors import SingularError
from continuum_loc.estimator.chain import Chain
from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.fit import consistency
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.state import Column, NODE_DIM
from continuum_loc.estimator.window import Window
import numpy as np

EARLY = 5.0  # [s] of data in which what is wrong has to be found soon
LATER = 3  # intervals that one solve serves from then on
FOUND = 0.5  # [s] of data in which the body still finds its place, and seems to move
ROTATION = np.arange(3, 6)  # of a node's state


@dataclass(slots=True, eq=False)
class Apart:
    """Columns of a window without some sensors, and their elimination for covariances."""

    columns: list[Column]
    chain: Chain

    @classmethod
    def of(cls, window: Window, factor: Factor, sensor: str = '') -> Apart | None:
        """
        Take out what a factor's sensors told, or one of them; None where there is no solution.

        Only the intervals before the first that is to be linearised anew: what those after it say
        is not known where the body is now.
        """
        normals, columns = [], window.columns
        for k, interval in enumerate(window.intervals[: settled(window)]):
            own = interval.share_of(factor, columns[k], columns[k + 1], sensor)
            normals.append(Normal(interval.normal.H - own.H, interval.normal.g - own.g))
        chain = Chain(window.grid.dim, window.chain.marginals[0])
        try:
            offsets = chain.solve(normals, 0)
        except SingularError:
            return None
        return cls([one.retract(by) for one, by in zip(columns, offsets, strict=False)], chain)

    def turns(self, k: int, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (m, 3, 3) of nodes (m,) over interval k, and their covariances [rad^2]."""
        a, b = self.columns[k], self.columns[k + 1]
        R = a.T[nodes, :3, :3].transpose(0, 2, 1) @ b.T[nodes, :3, :3]
        A = np.zeros((len(nodes), 3, self.chain.dim))
        B = np.zeros_like(A)
        for i, node in enumerate(nodes):
            rotation = NODE_DIM * node + ROTATION
            A[i][:, rotation] = -R[i].T
            B[i][:, rotation] = np.eye(3)
        A, B = A.reshape(-1, self.chain.dim), B.reshape(-1, self.chain.dim)
        return R, self.chain.covariance(k, A, B, size=3, step=3)

    def covariance(self, k: int, node: int, part: slice) -> np.ndarray:
        """Covariance of one part of a node's state in column k."""
        rows = NODE_DIM * node + np.arange(NODE_DIM)[part]
        A = np.zeros((len(rows), self.chain.dim))
        A[np.arange(len(rows)), rows] = 1.0
        return self.chain.covariance(k, A)


class Comparison(ABC):
    """Hears every interval once, as soon as another follows it, with a body without `factor`."""

    at_once: int = 1  # intervals that one solve serves at first

    def __init__(self, factor: Factor):
        self.factor = factor
        self._heard_to = -np.inf

    def look(self, window: Window) -> dict[str, str] | None:
        """Hear the intervals that are due; causes by sensor, None where nothing was due."""
        last = settled(window) - 1
        first = max(self._heard_to, FOUND)
        due = [k for k in range(1, last) if window.intervals[k].start > first]
        # At first each at once, later several for one solve.
        early = window.columns[-1].time < EARLY
        if len(due) < min(self.at_once if early else LATER, max(last - 1, 1)):
            return None
        body = Apart.of(window, self.factor)
        if body is None:
            return None
        others = ('gyro', self.factor.name)
        for k in due:
            interval = window.intervals[k]
            self.hear(interval, k, body, max(consistency([interval], without=others), 1.0))
        self._heard_to = window.intervals[due[-1]].start
        return self.causes()

    @abstractmethod
    def hear(self, interval: Interval, k: int, body: Apart, misfit: float) -> None:
        """
        Compare what was read in interval k with a body.

        misfit: mean squared residual of what that body was estimated from, at least 1.
        """

    @abstractmethod
    def causes(self) -> dict[str, str]:
        """Say what is certainly wrong with each sensor, '' where nothing is."""


def settled(window: Window) -> int:
    """Count the intervals before the first that has to be linearised anew."""
    changed = (k for k, one in enumerate(window.intervals) if one.changed)
    return next(changed, len(window.intervals))
