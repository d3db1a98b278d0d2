"""
Measured poses of a node: an external tracker's, and the insertion encoder's pose of the base.

e = Log(T_measured^-1 T), J = J_r(e)^-1 for a right perturbation.
"""

from __future__ import annotations

from continuum_loc import lie, lie_kernels
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, known_sensor, require_finite
from continuum_loc.estimator.state import VELOCITY
from continuum_loc.measurements import EncoderSample, TrackedPose
from numba import njit
import numpy as np


class _PoseFactor(Factor):
    cauchy = np.inf

    def stack(self, times, rows):
        nodes = np.array([row[0] for row in rows])
        order = np.argsort(nodes, kind='stable')  # node by node
        arrays = (np.array([rows[m][i] for m in order]) for i in (1, 2))
        return times[order], nodes[order], *arrays

    def linearise(self, batch, a, b, blocks):
        times, nodes, T_map_measured, information = batch
        cost, squared = _add(
            blocks.H,
            blocks.g,
            a.T,
            a.velocity,
            b.T,
            b.velocity,
            b.time - a.time,
            times,
            nodes,
            T_map_measured,
            information,
            self.cauchy,
        )
        return FactorReport(
            cost, squared, int(np.sum(np.diagonal(information, axis1=1, axis2=2) > 0.0))
        )


class TrackerFactor(_PoseFactor):
    """Pose of a sensor from an external tracker (EM, motion capture)."""

    name = 'tracker'
    consumes = TrackedPose

    def __init__(self, robot, grid, settings):
        super().__init__(robot, grid, settings)
        self.cauchy = settings.tracker.cauchy
        self._sensors = {
            sensor.name: (
                grid.node_at(robot.sensor_arclength(sensor.name)),
                lie.inverse(sensor.mount.T_ring_sensor),
            )
            for sensor in robot.trackers
        }
        self._default = (
            np.array(
                [settings.tracker.sigma_position] * 3
                + [np.radians(settings.tracker.sigma_rotation_deg)] * 3
            )
            ** -2.0
        )

    def row(self, measurement: TrackedPose) -> tuple:
        node, T_sensor_ring = known_sensor(self._sensors, measurement.sensor, 'tracker')
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
        return node, measurement.T_map_sensor @ T_sensor_ring, information


class InsertionFactor(_PoseFactor):
    """Base travel along its own x axis, from the joint state `insertion`."""

    name = 'insertion'
    consumes = EncoderSample

    def row(self, measurement: EncoderSample) -> tuple:
        insertion = self.robot.base.insertion
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
        T_map_measured = self.robot.base.T_map_base.copy()
        T_map_measured[:3, 3] += travel * T_map_measured[:3, 0]
        information = np.zeros((6, 6))
        information[0, 0] = insertion.sigma**-2.0
        return 0, T_map_measured, information


@njit(cache=True)
def _add(H, g, T_a, v_a, T_b, v_b, dt, times, nodes, T_measured, information, cauchy):
    W, V, M = lie_kernels.workspace()
    W_own, V_own, M_own = lie_kernels.workspace()  # what `relate` left in the other one is kept
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((6, 24)), np.empty((0, 24))
    H_node, g_node = np.zeros((24, 24)), np.zeros(24)
    e, weighted, index = np.empty(6), np.empty(6), np.empty(24, np.int64)
    J, work, local, slope = np.empty((6, 6)), np.empty((6, 24)), np.empty((6, 6)), np.empty(6)
    size = H.shape[0] // 2
    cost, squared, related = 0.0, 0.0, -1
    for m in range(times.shape[0]):
        n = nodes[m]
        if n != related:  # poses of a node come after one another
            gp.relate(T_a[n], T_b[n], v_b[n], W, V, M)
            related = n
        gp.evaluate(T_a[n], v_a[n], dt, times[m], T, v, J_pose, J_rate, W, V, M, J_work)
        lie_kernels.pose_error(T_measured[m], T, e, J, W_own, V_own, M_own)
        lie_kernels.apply(information[m], e, weighted)
        u2 = 0.0
        for i in range(6):
            u2 += e[i] * weighted[i]
        robust = 1.0 / (1.0 + u2 / (cauchy * cauchy))
        lie_kernels.product(information[m], J, W_own[0])
        for i in range(6):
            slope[i] = 0.0
            for k in range(6):
                slope[i] += robust * J[k, i] * weighted[k]
            for j in range(6):
                local[i, j] = 0.0
                for k in range(6):
                    local[i, j] += robust * J[k, i] * W_own[0, k, j]
        gp.gather(H_node, g_node, local, slope, J_pose, work)
        if m + 1 == times.shape[0] or nodes[m + 1] != n:
            gp.time_index(n, VELOCITY, size, index)
            gp.scatter(H, g, index, H_node, g_node, 1.0)
        cost += (
            0.5 * u2
            if np.isinf(cauchy)
            else 0.5 * cauchy * cauchy * np.log1p(u2 / (cauchy * cauchy))
        )
        squared += u2 * robust
    return cost, squared
