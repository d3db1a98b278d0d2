"""
A strain sensor compared with a body in whose estimate it has no say.

Its readings are taken as described, and in other units and angles; whichever of them is the
bending of the body at its nodes, within the covariance of that and the sensor's own noise, is how
they are meant. What was read in one interval after another adds up.
"""

from __future__ import annotations

from collections import deque

from continuum_loc.estimator.apart import Apart, Comparison
from continuum_loc.estimator.factors import Factor, Setup
from continuum_loc.estimator.interpolation import body_between
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.readings import bending_read, STRAIN_CAUSES
from continuum_loc.estimator.state import NODE_DIM, STRAIN
from continuum_loc.measurements import StrainSample
import numpy as np

SAMPLES = 64  # that wait for their interval
MEMORY = 5.0  # [s] in which what was heard counts half
CERTAIN = 12.0  # nats that a cause has to be likelier by than the description
TIMES = 2.0  # and how much smaller its squares have to be
BENDING = (4, 5)  # of a node's strain


class BendWatch(Comparison):
    """Compares a strain sensor with the bending of the body."""

    at_once = 2  # it tells by the shape, which stays longer than a motion

    def __init__(self, setup: Setup, strain: Factor):
        super().__init__(strain)
        self._grid = setup.grid
        self._variance = (setup.settings.strain.scale * setup.robot.strain.kappa_sigma) ** 2
        self._keep = 0.5 ** (setup.settings.knot_period / MEMORY)
        self._samples: deque[tuple[float, StrainSample]] = deque(maxlen=SAMPLES)
        self._squares = np.zeros(len(READ_AS))

    def note(self, time: float, sample: StrainSample) -> None:
        """Keep a sample, read at `time` [s], until its interval is heard."""
        self._samples.append((time, sample))

    def hear(self, interval: Interval, k: int, body: Apart, misfit: float) -> None:
        a, b = body.columns[k], body.columns[k + 1]
        samples = [(time, one) for time, one in self._samples if a.time < time <= b.time]
        if not samples:
            return
        bent = [body_between(a, b, time).strain[:, BENDING] for time, _ in samples]
        read = [[self._at_nodes(one, way) for way in READ_AS] for _, one in samples]
        error = np.mean(np.array(read) - np.array(bent)[:, None], axis=0)  # (ways, N, 2)
        error = error.reshape(len(READ_AS), -1)
        S = misfit * self._covariance(body, k + 1) + self._variance * np.eye(error.shape[1])
        squares = np.einsum('hi,hi->h', error, np.linalg.solve(S, error.T).T)
        self._squares = self._keep * self._squares + squares

    def causes(self) -> dict[str, str]:
        best = int(np.argmin(self._squares))
        least, described = self._squares[best], self._squares[0]
        clear = described - least > 2.0 * CERTAIN and described > TIMES * least
        return {'strain': list(STRAIN_CAUSES)[best - 1] if clear else ''}

    def _at_nodes(self, sample: StrainSample, change) -> np.ndarray:
        """Bending (N, 2) at the nodes, of a sample that is read in one way."""
        bending = bending_read(*change(sample.theta, sample.kappa))
        s = self._grid.s
        return np.column_stack([np.interp(s, sample.s, bending[:, axis]) for axis in (0, 1)])

    def _covariance(self, body: Apart, column: int) -> np.ndarray:
        """Covariance (2 N, 2 N) of the nodes' bendings."""
        A = np.zeros((2 * self._grid.nodes, self._grid.dim))
        for n in range(self._grid.nodes):
            for i, axis in enumerate(BENDING):
                A[2 * n + i, NODE_DIM * n + STRAIN + axis] = 1.0
        return body.chain.covariance(column, A)


# The description first.
READ_AS = [lambda theta, kappa: (theta, kappa), *STRAIN_CAUSES.values()]
