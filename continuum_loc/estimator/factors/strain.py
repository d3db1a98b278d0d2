"""
FBG-like strain (paper eqs. 7-9), masked to the two curvatures that (theta, kappa) really measures.

The measured bending is kappa (-sin theta, cos theta). Its noise is sigma_kappa along it and kappa
sigma_theta across; a nearly straight station says nothing about theta, so the latter never falls
below sigma_kappa.
"""

from __future__ import annotations

from continuum_loc import lie_kernels
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, require_finite
from continuum_loc.estimator.state import NODE_DIM, STRAIN
from continuum_loc.measurements import StrainSample
from numba import njit
import numpy as np


class StrainFactor(Factor):
    """
    Bending strain at any number of stations.

    It is interpolated in arclength at both knots and linearly in time.
    """

    name = 'strain'
    consumes = StrainSample

    def row(self, measurement: StrainSample) -> tuple:
        if self.robot.strain is None:
            raise MeasurementError(
                'unknown frame', f"robot '{self.robot.name}' has no strain sensor"
            )
        s, theta, kappa = measurement.s, measurement.theta, measurement.kappa
        for values, what in ((s, 'arclength'), (theta, 'bending angle'), (kappa, 'curvature')):
            require_finite(values, what, 'strain')
        if len(s) == 0 or not len(s) == len(theta) == len(kappa):
            raise MeasurementError(
                'wrong size',
                f'strain needs as many s, theta, kappa, got {len(s)}, {len(theta)}, {len(kappa)}',
            )
        if np.min(s) < -1e-9 or np.max(s) > self.robot.length + 1e-9:
            raise MeasurementError(
                'off the body',
                f'strain stations from {np.min(s)} to {np.max(s)} m; the robot is '
                f'{self.robot.length} m long',
            )
        bending = np.column_stack([-kappa * np.sin(theta), kappa * np.cos(theta)])
        return s, bending, self._information(bending, kappa)

    def _information(self, bending: np.ndarray, kappa: np.ndarray) -> np.ndarray:
        """(M, 2, 2) information of the bending strain."""
        noise, scale = self.robot.strain, self.settings.strain.scale
        radial = (scale * noise.kappa_sigma) ** 2
        tangential = np.maximum((scale * noise.theta_sigma * kappa) ** 2, radial)
        along = bending / np.maximum(np.abs(kappa), 1e-12)[:, None]
        outer = along[:, :, None] * along[:, None, :]
        return (
            np.eye(2) / tangential[:, None, None]
            + outer * (1.0 / radial - 1.0 / tangential)[:, None, None]
        )

    def stack(self, times, rows):
        """
        Rows of one interval grouped by station.

        The geometry of a station serves all its samples.
        """
        s = np.concatenate([row[0] for row in rows])
        stations, station = rows[0][0], np.tile(np.arange(len(rows[0][0])), len(rows))
        if len(s) != len(station) or not np.array_equal(s, stations[station]):
            # Not the same stations every time.
            stations, station = np.unique(s, return_inverse=True)
        return (
            np.repeat(times, [len(row[0]) for row in rows]),
            station.astype(np.int64),
            np.concatenate([row[1] for row in rows]),
            np.concatenate([row[2] for row in rows]),
            *self.grid.segments(stations),
        )

    def linearise(self, batch, a, b, blocks):
        cost, squared = _add(
            blocks.H,
            blocks.g,
            a.T,
            a.strain,
            b.T,
            b.strain,
            b.time - a.time,
            self.grid.s,
            *batch,
            self.settings.strain.cauchy,
        )
        return FactorReport(cost, squared, 2 * len(batch[0]))


@njit(cache=True)
def _add(
    H,
    g,
    T_a,
    eps_a,
    T_b,
    eps_b,
    dt,
    s,
    times,
    station,
    bending,
    information,
    segments,
    offsets,
    cauchy,
):
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, rate, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((0, 24)), np.empty((2, 24))
    stations = segments.shape[0]
    local = np.zeros((stations, 4, 4))  # information of [bending at a; bending at b]
    slope = np.zeros((stations, 4))
    values = np.empty((stations, 4))
    jacobians = np.zeros((stations, 4, 48))
    for half in range(2):
        T_end, eps = (T_a, eps_a) if half == 0 else (T_b, eps_b)
        related = -1
        for m in range(stations):
            n, ds = segments[m], s[segments[m] + 1] - s[segments[m]]
            if n != related:  # stations of a segment come after one another
                gp.relate(T_end[n], T_end[n + 1], eps[n + 1], W, V, M)
                related = n
            gp.evaluate(T_end[n], eps[n], ds, offsets[m], T, rate, J_pose, J_rate, W, V, M, J_work)
            for i in range(2):
                values[m, 2 * half + i] = rate[4 + i]
                for j in range(24):
                    jacobians[m, 2 * half + i, 24 * half + j] = J_rate[i, j]
    cost, squared = 0.0, 0.0
    c2 = cauchy * cauchy
    for r in range(times.shape[0]):
        m, u = station[r], times[r] / dt
        e0 = (1.0 - u) * values[m, 0] + u * values[m, 2] - bending[r, 0]
        e1 = (1.0 - u) * values[m, 1] + u * values[m, 3] - bending[r, 1]
        a, b, c = information[r, 0, 0], information[r, 0, 1], information[r, 1, 1]
        u2 = a * e0 * e0 + 2.0 * b * e0 * e1 + c * e1 * e1
        robust = 1.0 / (1.0 + u2 / c2)
        f0, f1 = robust * (a * e0 + b * e1), robust * (b * e0 + c * e1)
        for i in range(2):
            share = 1.0 - u if i == 0 else u
            slope[m, 2 * i] += share * f0
            slope[m, 2 * i + 1] += share * f1
            for j in range(2):
                both = share * (1.0 - u if j == 0 else u) * robust
                local[m, 2 * i, 2 * j] += both * a
                local[m, 2 * i, 2 * j + 1] += both * b
                local[m, 2 * i + 1, 2 * j] += both * b
                local[m, 2 * i + 1, 2 * j + 1] += both * c
        cost += 0.5 * c2 * np.log1p(u2 / c2)
        squared += u2 * robust
    index, work = np.empty(48, np.int64), np.empty((4, 48))
    H_segment, g_segment = np.zeros((48, 48)), np.zeros(48)
    size = H.shape[0] // 2
    for m in range(stations):
        gp.gather(H_segment, g_segment, local[m], slope[m], jacobians[m], work)
        if m + 1 < stations and segments[m + 1] == segments[m]:
            continue
        for i in range(6):
            for half in range(2):
                start = half * size + NODE_DIM * segments[m]
                index[24 * half + i] = start + i
                index[24 * half + 6 + i] = start + STRAIN + i
                index[24 * half + 12 + i] = start + NODE_DIM + i
                index[24 * half + 18 + i] = start + NODE_DIM + STRAIN + i
        gp.scatter(H, g, index, H_segment, g_segment, 1.0)
    return cost, squared
