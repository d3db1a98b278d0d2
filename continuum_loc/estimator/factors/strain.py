"""
FBG-like strain (paper eqs. 7-9), masked to the two curvatures that (theta, kappa) really measures.

The measured bending is kappa (-sin theta, cos theta). Its noise is sigma_kappa along it and kappa
sigma_theta across; a nearly straight station says nothing about theta, so the latter never falls
below sigma_kappa.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.compiling import kernel
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, require_finite
from continuum_loc.estimator.normal import gather, new_normal, Normal, scatter
from continuum_loc.estimator.state import ends_along, rows_along, STRAIN
from continuum_loc.measurements import StrainSample
import numpy as np


class Row(NamedTuple):
    """One sample: arclengths (M,), bending strain (M, 2) and its information (M, 2, 2)."""

    s: np.ndarray
    bending: np.ndarray
    information: np.ndarray


class Batch(NamedTuple):
    """
    R readings of S stations.

    A reading: its time, station, bending (2,) and information (2, 2). A station: its segment and
    distance from the segment's first node.
    """

    times: np.ndarray
    station: np.ndarray
    bending: np.ndarray
    information: np.ndarray
    segments: np.ndarray
    offsets: np.ndarray


class Stations(NamedTuple):
    """Bending of S stations at both knots, and what readings say of these four numbers."""

    values: np.ndarray  # (S, 4)
    J: np.ndarray  # (S, 4, 48) by the segment's two nodes, first at one knot, then at the other
    H: np.ndarray  # (S, 4, 4)
    g: np.ndarray  # (S, 4)


class Loss(NamedTuple):
    """Scale of the robust loss, and what the sensor counts by."""

    cauchy: float
    weight: float


class StrainFactor(Factor):
    """Bending strain at any stations, by the Hermite in arclength and linearly in time."""

    name = 'strain'
    consumes = StrainSample
    batch = Batch

    def __init__(self, setup):
        super().__init__(setup, ['strain'])

    def row(self, measurement: StrainSample) -> Row:
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
        return Row(s, bending, self._information(bending, kappa))

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
        """Group the readings by station, whose geometry serves all its samples."""
        s, bending, information = (np.concatenate(part) for part in zip(*rows, strict=True))
        stations, station = rows[0].s, np.tile(np.arange(len(rows[0].s)), len(rows))
        if len(s) != len(station) or not np.array_equal(s, stations[station]):
            # Not the same stations every time.
            stations, station = np.unique(s, return_inverse=True)
        return Batch(
            np.repeat(times, [len(row.s) for row in rows]),
            station.astype(np.int64),
            bending,
            information,
            *self.grid.segments(stations),
        )

    def linearise(self, batch, a, b, normal):
        loss = Loss(self.settings.strain.cauchy, self.weights[0])
        cost, squared = _add(normal, a, b, self.grid.s, batch, loss, self._work)
        return FactorReport(cost, squared, 2 * len(batch.times))

    def bordered(self, batch, a, b, border, of):
        columns = np.hstack([of.columns(kind, ['strain']) for kind in ('strain', 'clock')])[0]
        loss = Loss(self.settings.strain.cauchy, self.weights[0])
        _add_border(border, a, b, self.grid.s, batch, loss, columns, self._work)

    def awaited(self):
        return self.robot.strain is not None

    def guess(self, row, guess):
        order = np.argsort(row.s)
        for i in range(2):
            bending = row.bending[order, i]
            guess.strain[:, 4 + i] = np.interp(self.grid.s, row.s[order], bending)


@kernel
def _add(normal, a, b, s, batch, loss, work):
    """Add the readings; returns the robust cost and the sum of weighted squared residuals."""
    count, dim = batch.segments.shape[0], normal.g.shape[0] // 2
    stations = Stations(
        np.empty((count, 4)),
        np.zeros((count, 4, 48)),
        np.zeros((count, 4, 4)),
        np.zeros((count, 4)),
    )
    _predict(a, s, batch, stations, 0, work)
    _predict(b, s, batch, stations, 1, work)
    cost, squared = _read(b.time - a.time, batch, stations, loss.cauchy * loss.cauchy)
    index, product, total = np.empty(48, np.int64), np.empty((4, 48)), new_normal(48)
    for m in range(count):
        n = batch.segments[m]
        gather(total, Normal(stations.H[m], stations.g[m]), stations.J[m], product)
        if m + 1 < count and batch.segments[m + 1] == n:
            continue
        rows_along(n, STRAIN, index)
        for i in range(24):
            index[24 + i] = dim + index[i]
        scatter(normal, index, total, loss.weight)
    return loss.weight * cost, squared


@kernel
def _add_border(border, a, b, s, batch, loss, columns, work):
    """Add what the readings say of scale, twist, offsets and clock of the sensor."""
    count, dim, dt = batch.segments.shape[0], border.C.shape[0] // 2, b.time - a.time
    stations = Stations(
        np.empty((count, 4)), np.zeros((count, 4, 48)), np.empty((0, 4, 4)), np.empty((0, 4))
    )
    _predict(a, s, batch, stations, 0, work)
    _predict(b, s, batch, stations, 1, work)
    coupled, D, WD = np.zeros((count, 4, 5)), np.zeros((2, 5)), np.zeros((2, 5))
    e, c2 = np.empty(2), loss.cauchy * loss.cauchy
    for r in range(batch.times.shape[0]):
        m, u = batch.station[r], batch.times[r] / dt
        value, information = stations.values[m], batch.information[r]
        for i in range(2):
            e[i] = (1.0 - u) * value[i] + u * value[2 + i] - batch.bending[r, i]
            D[i, 0], D[i, 2 + i] = batch.bending[r, i], 1.0
            D[i, 4] = (value[2 + i] - value[i]) / dt
        D[0, 1], D[1, 1] = -batch.bending[r, 1], batch.bending[r, 0]
        u2 = 0.0
        for i in range(2):
            for j in range(2):
                u2 += e[i] * information[i, j] * e[j]
        weight = loss.weight / (1.0 + u2 / c2)
        for i in range(2):
            for p in range(5):
                WD[i, p] = weight * (information[i, 0] * D[0, p] + information[i, 1] * D[1, p])
                coupled[m, i, p] += (1.0 - u) * WD[i, p]
                coupled[m, 2 + i, p] += u * WD[i, p]
        for p in range(5):
            if columns[p] < 0:
                continue
            for i in range(2):
                border.g[columns[p]] += WD[i, p] * e[i]
                for q in range(5):
                    if columns[q] >= 0:
                        border.H[columns[p], columns[q]] += D[i, p] * WD[i, q]
    index = np.empty(48, np.int64)
    for m in range(count):
        rows_along(batch.segments[m], STRAIN, index)
        for i in range(24):
            index[24 + i] = dim + index[i]
        for p in range(5):
            if columns[p] < 0:
                continue
            for i in range(4):
                for j in range(48):
                    border.C[index[j], columns[p]] += stations.J[m, i, j] * coupled[m, i, p]


@kernel
def _predict(column, s, batch, stations, half, work):
    """Find the stations' bending at the older (half 0) or newer (1) knot."""
    related = -1
    for m in range(batch.segments.shape[0]):
        n = batch.segments[m]
        if n != related:  # stations of a segment come after one another
            gp.relate(ends_along(column.T, column.strain, s, n), work)
            related = n
        gp.evaluate(work, batch.offsets[m], False, 4)
        at = work[0]
        for i in range(2):
            stations.values[m, 2 * half + i] = at.v[4 + i]
            for j in range(24):
                stations.J[m, 2 * half + i, 24 * half + j] = at.J_rate[4 + i, j]


@kernel
def _read(dt, batch, stations, c2):
    """Add what each reading says to its station; returns the robust cost and squared error."""
    cost, squared, share = 0.0, 0.0, np.empty(2)
    for r in range(batch.times.shape[0]):
        m, u = batch.station[r], batch.times[r] / dt
        share[0], share[1] = 1.0 - u, u
        value, H, g = stations.values[m], stations.H[m], stations.g[m]
        e0 = share[0] * value[0] + u * value[2] - batch.bending[r, 0]
        e1 = share[0] * value[1] + u * value[3] - batch.bending[r, 1]
        information = batch.information[r]
        p, q, w = information[0, 0], information[0, 1], information[1, 1]
        u2 = p * e0 * e0 + 2.0 * q * e0 * e1 + w * e1 * e1
        robust = 1.0 / (1.0 + u2 / c2)
        f0, f1 = robust * (p * e0 + q * e1), robust * (q * e0 + w * e1)
        for i in range(2):
            g[2 * i] += share[i] * f0
            g[2 * i + 1] += share[i] * f1
            for j in range(2):
                both = share[i] * share[j] * robust
                H[2 * i, 2 * j] += both * p
                H[2 * i, 2 * j + 1] += both * q
                H[2 * i + 1, 2 * j] += both * q
                H[2 * i + 1, 2 * j + 1] += both * w
        cost += 0.5 * c2 * np.log1p(u2 / c2)
        squared += u2 * robust
    return cost, squared
