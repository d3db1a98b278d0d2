"""
Measured poses of a node: an external tracker's, and the insertion encoder's pose of the base.

e = Log(T_measured^-1 T), J = J_r(e)^-1 for a right perturbation.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie, lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, known_sensor, require_finite
from continuum_loc.estimator.interpolation import interpolated
from continuum_loc.estimator.normal import gather, new_normal, scatter
from continuum_loc.estimator.readings import travel_cause
from continuum_loc.estimator.state import ends_in_time, rows_in_time
from continuum_loc.measurements import EncoderSample, TrackedPose
from continuum_loc.robot import Insertion
import numpy as np

FIT_SQUARED = 27.9  # chi-squared of six degrees of freedom at 1e-4
LEAST_WEIGHT = 0.01  # of what a doubted sensor of another kind counts by


class Row(NamedTuple):
    """One pose of a node (4, 4), and its information (6, 6) in the node's frame."""

    sensor: int
    node: int
    T_map_node: np.ndarray
    information: np.ndarray


class Batch(NamedTuple):
    times: np.ndarray
    sensors: np.ndarray
    nodes: np.ndarray
    T_map_node: np.ndarray
    information: np.ndarray


class Loss(NamedTuple):
    """
    Scale of the robust loss, what each of S sensors counts by, and its [usable, fitting].

    plain: squared error up to which the loss is a square.
    """

    cauchy: float
    plain: float
    weights: np.ndarray
    fits: np.ndarray


class _PoseFactor(Factor):
    batch = Batch
    cauchy: float
    plain = 0.0

    def stack(self, times, rows):
        order = np.argsort([row.node for row in rows], kind='stable')  # node by node
        return super().stack(times[order], [rows[m] for m in order])

    def linearise(self, batch, a, b, normal):
        fits = np.zeros((len(self.sensors), 2))
        loss = Loss(self.cauchy, self.plain, self.weights, fits)
        cost, squared = _add(normal, a, b, batch, loss, self._work)
        observed = np.diagonal(batch.information, axis1=1, axis2=2) > 0.0
        return FactorReport(cost, squared, int(np.sum(observed)), fits)

    def bordered(self, batch, a, b, border, of):
        found = interpolated(a, b, batch.times, batch.nodes, pose=True, rate=True)
        error = lie.log(lie.inverse(batch.T_map_node) @ found.T)
        right = lie.right_jacobian_inverse(error)
        squared = np.einsum('mi,mij,mj->m', error, batch.information, error)
        beyond = np.maximum(squared - self.plain, 0.0)
        weight = self.weights[batch.sensors] / (1.0 + beyond / self.cauchy**2)
        for m, (columns, by) in enumerate(self._constants(batch, found, error, of)):
            rows = np.empty(24, np.int64)
            rows_in_time(batch.nodes[m], self.grid.dim, rows)
            W = weight[m] * batch.information[m]
            border.add(rows, right[m] @ found.J_pose[m], columns, by, W, error[m])

    def _constants(self, batch, found, error, of):
        """Yield columns (p,) in theta of each pose's constants and its error's slope (6, p)."""
        return iter(())

    def weigh(self, doubted, weight):
        # A pose says all of its node at once, and an encoder has no loss: 5 % would be too much.
        return super().weigh(doubted, LEAST_WEIGHT * weight)


class TrackerFactor(_PoseFactor):
    """Pose of a sensor from an external tracker (EM, motion capture)."""

    name = 'tracker'
    consumes = TrackedPose

    def __init__(self, setup):
        super().__init__(setup, [sensor.name for sensor in setup.robot.trackers])
        options = self.settings.tracker
        self.cauchy = options.cauchy
        self.describe(setup.robot)
        turn = np.radians(options.sigma_rotation_deg)
        self._default = np.array([options.sigma_position] * 3 + [turn] * 3) ** -2.0

    def describe(self, robot):
        super().describe(robot)
        self._sensors = {
            sensor.name: (
                number,
                self.grid.node_at(self.robot.sensor_arclength(sensor.name)),
                lie.inverse(sensor.mount.T_ring_sensor),
            )
            for number, sensor in enumerate(self.robot.trackers)
        }

    def row(self, measurement: TrackedPose) -> Row:
        number, node, T_sensor_ring = known_sensor(self._sensors, measurement.sensor, 'tracker')
        require_finite(measurement.T_map_sensor, 'pose', measurement.sensor)
        Ad = lie.adjoint(lie.inverse(T_sensor_ring))  # sensor-frame covariance to the ring's frame
        information = np.diag(self._default)
        if np.any(measurement.covariance):
            try:
                information = np.linalg.inv(Ad @ measurement.covariance @ Ad.T)
                np.linalg.cholesky(information)
            except np.linalg.LinAlgError:
                raise MeasurementError(
                    'bad covariance',
                    f"covariance of '{measurement.sensor}' is not positive definite",
                ) from None
        return Row(number, node, measurement.T_map_sensor @ T_sensor_ring, information)

    def _constants(self, batch, found, error, of):
        columns = np.hstack([of.columns(kind, self.sensors) for kind in ('mount', 'clock')])
        mounts = [lie.adjoint(sensor.mount.T_ring_sensor) for sensor in self.robot.trackers]
        left, right = lie.left_jacobian_inverse(error), lie.right_jacobian_inverse(error)
        by_mount = left @ np.array(mounts)[batch.sensors]
        by_clock = right @ found.v[:, :, None]
        yield from zip(
            columns[batch.sensors], np.concatenate([by_mount, by_clock], axis=2), strict=True
        )


def travel_of(measurement: EncoderSample, insertion: Insertion) -> float:
    """Read the travel of the base [m]. Raises MeasurementError where it cannot be used."""
    if insertion.mode != 'measured':
        raise MeasurementError(
            'not used', f"insertion is '{insertion.mode}' in the robot description"
        )
    if 'insertion' not in measurement.names:
        raise MeasurementError(
            'not used', f"no joint 'insertion' among {', '.join(measurement.names)}"
        )
    travel = float(measurement.position[measurement.names.index('insertion')])
    require_finite(np.array(travel), 'insertion', 'joint_states')
    if beyond := travel_cause(travel, insertion.range):
        raise MeasurementError('beyond range', f"joint 'insertion' {beyond}")
    return travel


class InsertionFactor(_PoseFactor):
    """Base travel along its own x axis, from the joint state `insertion`."""

    name = 'insertion'
    consumes = EncoderSample
    cauchy = 2.0  # an encoder that all the rest contradicts is let go, one within 5 sigma is not
    plain = 9.0

    def __init__(self, setup):
        super().__init__(setup, ['insertion'])
        if self.settings.calibration.enabled:
            # A base that is a little off as built is no reason to let its encoder go.
            built = setup.robot.tolerances.base_position / setup.robot.base.insertion.sigma
            self.plain = self.plain * (1.0 + built**2)

    def row(self, measurement: EncoderSample) -> Row:
        base = self.robot.base
        insertion = base.insertion
        travel = travel_of(measurement, insertion)
        T_map_base = self.robot.base.T_map_base.copy()
        T_map_base[:3, 3] += travel * T_map_base[:3, 0]
        information = np.zeros((6, 6))
        if base.mode == 'fixed':  # what a free one travels from is known at the start alone
            information[0, 0] = insertion.sigma**-2.0
        return Row(0, 0, T_map_base, information)

    def _constants(self, batch, found, error, of):
        columns = of.columns('base', [''])[0]
        back = lie.adjoint(lie.inverse(batch.T_map_node) @ self.robot.base.T_map_base)
        for by in -lie.left_jacobian_inverse(error) @ back:
            yield columns, by

    @classmethod
    def wanted(cls, setup):
        return setup.robot.base.mode != 'measured' and super().wanted(setup)

    def awaited(self):
        return self.robot.base.insertion.mode == 'measured'

    def guess(self, row, guess):
        guess.T_map_base = row.T_map_node


@kernel
def _add(normal, a, b, batch, loss, work):
    """Add the poses; returns the robust cost and the sum of weighted squared residuals."""
    total, local, index = new_normal(24), new_normal(6), np.empty(24, np.int64)
    product, c2 = np.empty((6, 24)), loss.cauchy * loss.cauchy
    cost, squared, related = 0.0, 0.0, -1
    for m in range(batch.times.shape[0]):
        n = batch.nodes[m]
        if n != related:  # poses of a node come after one another
            gp.relate(ends_in_time(a, b, n), work)
            related = n
        gp.evaluate(work, batch.times[m], True, 6)
        sensor = batch.sensors[m]
        weight = loss.weights[sensor]
        u2, robust = _local(work, batch.T_map_node[m], batch.information[m], loss, local)
        for i in range(6):
            local.g[i] *= weight
            for j in range(6):
                local.H[i, j] *= weight
        gather(total, local, work[0].J_pose, product)
        loss.fits[sensor, 0] += 1.0
        if u2 < FIT_SQUARED:
            loss.fits[sensor, 1] += 1.0
        if m + 1 == batch.times.shape[0] or batch.nodes[m + 1] != n:
            rows_in_time(n, normal.g.shape[0] // 2, index)
            scatter(normal, index, total, 1.0)
        own = 0.5 * min(u2, loss.plain) + 0.5 * c2 * np.log1p(max(u2 - loss.plain, 0.0) / c2)
        cost += weight * own
        squared += u2 * robust
    return cost, squared


@kernel
def _local(work, T_measured, information, loss, local):
    """Write one pose's normal equations in its own frame; its squared error, and its weight."""
    at = work[0]
    gamma, J, scratch = at.gamma, at.right_gamma, at.scratch
    weighted, by_error = scratch.powers[0], scratch.matrix
    lie_kernels.pose_error(T_measured, at.T, gamma, J, scratch)
    lie_kernels.apply(information, gamma.x, weighted)
    u2 = 0.0
    for i in range(6):
        u2 += gamma.x[i] * weighted[i]
    robust = 1.0 / (1.0 + max(u2 - loss.plain, 0.0) / (loss.cauchy * loss.cauchy))
    lie_kernels.product(information, J, by_error)
    for i in range(6):
        local.g[i] = 0.0
        for k in range(6):
            local.g[i] += robust * J[k, i] * weighted[k]
        for j in range(6):
            local.H[i, j] = 0.0
            for k in range(6):
                local.H[i, j] += robust * J[k, i] * by_error[k, j]
    return u2, robust
