"""
Gyros compared with a body in whose estimate no gyro has a say.

A gyro along a wrong axis pulls the body to itself, and then fits, so the body is estimated
without (`apart`). That body's turn from knot to knot, with its covariance C, is what each gyro's
mean rate m (less noise) has to be, through one of several matrices G:

    m = G (t + D t + b) + noise,

with b the bias and D what a healthy gyro's scale and axes may be off by; both are marginalised
under what people build. The description says G = 1; degrees, swapped axes and turned signs are the
others. Their log likelihoods add up over the intervals, each of which is heard once.
"""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc import lie
from continuum_loc.estimator.apart import Apart, Comparison
from continuum_loc.estimator.factors import Factor, Setup
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.readings import GYRO_CAUSES
import numpy as np

OFF_SCALE = 0.04  # of each entry of a healthy gyro's scale and axes: 2 % and 2 degrees
MEMORY = 20.0  # [s] in which what was heard counts half
CERTAIN = 8.0  # nats that a cause has to be likelier by than the description
PER_CHANGE = 1.0  # nats that each exchanged axis or sign makes a cause less likely beforehand
FITS = 4.0  # mean squared residual up to which a cause explains an interval
TURNING = 16.0  # squared turn over its variance
LEAST_SHARE = 0.7  # of an interval's samples


@dataclass(slots=True, eq=False)
class Turn:
    """What the body turned by in an interval: rate (3,) in an IMU's axes, its covariance."""

    rate: np.ndarray
    covariance: np.ndarray

    @property
    def sure(self) -> bool:
        """Whether the body surely turns: beside a rest, a gyro that says nothing is right."""
        return float(self.rate @ np.linalg.solve(self.covariance, self.rate)) > TURNING


class Ledger:
    """
    How well each cause accounts for one gyro, the description first.

    Of the unknowns (12,) [bias, D] of every cause: information, vector and squares, as sums.
    """

    def __init__(self, bias_sigma: float, sample_sigma: float):
        self._prior = np.r_[np.full(3, bias_sigma), np.full(9, OFF_SCALE)] ** -2.0
        self._variance = sample_sigma**2
        self.clear()

    def clear(self) -> None:
        """Forget what was heard."""
        count = len(MATRICES)
        self._information = np.zeros((count, 12, 12))
        self._vector = np.zeros((count, 12))
        self._squares = np.zeros(count)

    def add(self, turn: Turn, mean: np.ndarray, samples: int, keep: float) -> None:
        """
        Hear the mean (3,) of so many samples over a turn.

        keep: share that what was heard before still counts by. What fits no cause is a hit, or a
        wrong body, and no argument.
        """
        G, spreads = MATRICES.copy(), SPREADS.copy()
        if not turn.sure:
            G[SLOW] = spreads[SLOW] = np.eye(3)  # as the description: a rest tells nothing
        S = spreads @ turn.covariance @ spreads.transpose(0, 2, 1)
        S += self._variance / samples * GAINS[:, None, None] ** 2 * np.eye(3)
        J = G @ np.hstack([np.eye(3), np.kron(np.eye(3), turn.rate)])
        error = mean - G @ turn.rate
        W = np.linalg.inv(S)
        expected = S + (J / self._prior) @ J.transpose(0, 2, 1)
        surprise = np.einsum('hi,hij,hj->h', error, np.linalg.inv(expected), error) / 3.0
        if surprise.min() > FITS:
            return
        WJ = W @ J
        self._information = keep * self._information + J.transpose(0, 2, 1) @ WJ
        self._vector = keep * self._vector + np.einsum('hij,hi->hj', WJ, error)
        squared = np.einsum('hi,hij,hj->h', error, W, error) + np.linalg.slogdet(S)[1]
        self._squares = keep * self._squares + squared

    def likelihoods(self) -> np.ndarray:
        """Log likelihood of each cause with the unknowns marginalised, and what it is worth."""
        posterior = self._information + np.diag(self._prior)
        explained = np.einsum(
            'hi,hi->h', self._vector, np.linalg.solve(posterior, self._vector[..., None])[..., 0]
        )
        volume = np.linalg.slogdet(posterior)[1] - np.log(self._prior).sum()
        return 0.5 * (explained - self._squares - volume) - BEFOREHAND

    def cause(self) -> str:
        """Name the cause that is certainly likelier than the description, or ''."""
        likely = self.likelihoods()
        best = int(np.argmax(likely))
        return CAUSES[best] if likely[best] > likely[0] + CERTAIN else ''


class TurnWatch(Comparison):
    """Compares gyros with the turns of the body."""

    def __init__(self, setup: Setup, gyro: Factor):
        super().__init__(gyro)
        robot, grid, settings = setup.robot, setup.grid, setup.settings
        self._nodes = np.array([grid.node_at(robot.sensor_arclength(i.name)) for i in robot.imu])
        self._axes = [imu.mount.T_ring_sensor[:3, :3] for imu in robot.imu]
        self._least = LEAST_SHARE * robot.imu_model.rate * settings.knot_period
        self._keep = 0.5 ** (settings.knot_period / MEMORY)
        bias, sigma = settings.gyro.bias_sigma, robot.imu_model.gyro_sigma
        self._ledgers = {imu.name: Ledger(bias, sigma) for imu in robot.imu}

    def hear(self, interval: Interval, k: int, body: Apart, misfit: float) -> None:
        span, rows = body.columns[k + 1].time - body.columns[k].time, interval.rows(self.factor)
        R, covariances = body.turns(k, self._nodes)
        covariances *= misfit / span**2
        for i, ledger in enumerate(self._ledgers.values()):
            read = [row.omega for row in rows if row.imu == i]
            if len(read) < self._least:
                continue
            to_imu = self._axes[i].T
            turn = Turn(to_imu @ lie.so3_log(R[i]) / span, to_imu @ covariances[i] @ to_imu.T)
            ledger.add(turn, to_imu @ np.mean(read, axis=0), len(read), self._keep)

    def causes(self) -> dict[str, str]:
        return {name: ledger.cause() for name, ledger in self._ledgers.items()}


CAUSES = ['', *(cause for cause, _, _ in GYRO_CAUSES)]
# What a gyro reads of a turn: the inverse of what makes the turn of its readings.
MATRICES = np.array([np.eye(3), *(np.linalg.inv(M) for _, M, _ in GYRO_CAUSES)])
BEFOREHAND = np.array([0.0, *(PER_CHANGE * n for _, _, n in GYRO_CAUSES)])
SLOW = 2  # reads next to nothing of any turn
# A gyro quieter than the body is known is none in another unit: no cause narrows its error.
GAINS = np.maximum(np.abs(MATRICES).max(axis=(1, 2)), 1.0)
SPREADS = MATRICES * (GAINS / np.abs(MATRICES).max(axis=(1, 2)))[:, None, None]
