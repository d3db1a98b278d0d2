"""
Information is the slope of the gradient where nothing is left over.

A covariance is the inverse of what the factors call information (H), and a wrong one moves no
estimate that has converged. At a state that the measurements fit exactly, Gauss-Newton's H is the
whole second derivative, so that it must be what the gradient changes by.
"""

from continuum_loc import lie
from continuum_loc.estimator.normal import Normal, symmetric
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.state import column_at_rest, Grid
from continuum_loc.magnet import ring_field
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    StrainSample,
    TofFrame,
    TrackedPose,
)
import numpy as np
import pytest
from test_factors import DT, make_factor, robot, SETTINGS
from worlds import cast, EPOCH

STEP = 1e-6
ROBOT = robot()
GRID = Grid(ROBOT, 0.16)
TRAVEL = {'insertion': 0.2, 'prior': 0.25}  # [m] as measured below, and the middle of its range
BENT = np.array([1.0, 0.0, 0.0, 0.0, 0.3, -0.4])


def resting(strain: np.ndarray, T_map_base: np.ndarray):
    """Lay the body at rest, at both ends of an interval."""
    a = column_at_rest(GRID, T_map_base, np.tile(strain, (GRID.nodes, 1)), 0.0)
    return a, a.predict(DT)


def normal_equations(kind: str, rows_and_times, a, b):
    """Symmetric H (2 D, 2 D) and g (2 D,) of the prior or of a factor between two columns."""
    normal = Normal.zeros(2 * GRID.dim)
    if kind == 'prior':
        Priors(ROBOT, GRID, SETTINGS).add(normal, a, b)
    else:
        factor, rows, times = rows_and_times
        factor.linearise(factor.stack(times, rows), a, b, normal)
    return symmetric(normal.H), normal.g.copy()


def pose_of(a, ring: str) -> np.ndarray:
    """T_map_ring of a body at rest."""
    return a.T[GRID.ring_nodes[1 + ROBOT.ring_names.index(ring)]]


def perfect(kind: str, a) -> list:
    """Measurements of a kind, just as the resting body gives them."""
    if kind in ('gyro', 'gravity'):
        samples = []
        for imu in ROBOT.imu:
            R = (pose_of(a, imu.ring) @ imu.mount.T_ring_sensor)[:3, :3]
            force = R.T @ [0.0, 0.0, 9.80665]
            samples += [ImuSample(EPOCH, imu.name, np.zeros(3), force)] * 3
        return samples
    if kind == 'strain':
        s, (y, z) = np.array([0.1, 0.22, 0.5]), BENT[4:]
        theta, kappa = np.arctan2(-y, z), np.hypot(y, z)
        return [StrainSample(EPOCH, s, np.full(3, theta), np.full(3, kappa))]
    if kind == 'tracker':
        coil = ROBOT.trackers[0]
        A = np.random.default_rng(1).normal(size=(6, 6))
        T = pose_of(a, coil.ring) @ coil.mount.T_ring_sensor
        return [TrackedPose(EPOCH, coil.name, T, 1e-4 * (A @ A.T + np.eye(6)))]
    if kind == 'field':
        hall = ROBOT.hall[0]
        T = lie.inverse(ROBOT.base.T_map_base) @ pose_of(a, hall.ring)
        field = T[:3, :3].T @ ring_field(ROBOT.magnet, T[:3, 3])
        return [FieldSample(EPOCH, hall.name, hall.mount.T_ring_sensor[:3, :3].T @ field)] * 2
    if kind == 'insertion':
        return [EncoderSample(EPOCH, ('insertion',), np.array([0.2]), np.zeros(1))]
    frames, rays = [], ROBOT.tof_model.directions
    for sensor in ROBOT.tof[:4]:
        T = pose_of(a, sensor.ring) @ sensor.mount.T_ring_sensor
        beams = rays @ T[:3, :3].T
        ranges = cast(np.broadcast_to(T[:3, 3], beams.shape), beams)
        status = np.full(len(rays), 5, np.uint8)
        frames.append(
            TofFrame(EPOCH, sensor.name, ranges[:, None] * rays, ranges, 0.01 * ranges, status)
        )
    return frames


@pytest.mark.parametrize(
    'kind', ['prior', 'gyro', 'strain', 'tof', 'tracker', 'insertion', 'gravity', 'field']
)
def test_information_is_the_slope_of_the_gradient(kind):
    """In random directions of all states; and where all fits, nothing is asked for."""
    travel = TRAVEL.get(kind, 0.0)
    base = ROBOT.base.T_map_base @ lie.exp(np.array([travel, 0, 0, 0, 0, 0]))
    strain = np.array(ROBOT.backbone.rest_strain) if kind == 'prior' else BENT
    a, b = resting(strain, base)
    measured = None
    if kind != 'prior':
        factor = make_factor(kind, ROBOT, GRID)
        rows = [factor.row(sample) for sample in perfect(kind, a)]
        measured = factor, rows, np.linspace(0.2, 0.9, len(rows)) * DT
    H, g = normal_equations(kind, measured, a, b)
    assert H.any() and np.linalg.eigvalsh(H)[0] > -1e-9 * np.abs(H).max()
    scale = np.sqrt(np.maximum(np.diagonal(H), 1e-12))
    assert np.abs(g / scale).max() < 1e-6  # in sigmas
    rng, dim = np.random.default_rng(0), GRID.dim
    for _ in range(4):
        x = rng.normal(size=2 * GRID.dim) / scale.max()
        ends = [
            normal_equations(
                kind,
                measured,
                a.retract(sign * STEP * x[:dim]),
                b.retract(sign * STEP * x[dim:]),
            )[1]
            for sign in (1.0, -1.0)
        ]
        slope, expected = (ends[0] - ends[1]) / (2.0 * STEP) / scale, H @ x / scale
        np.testing.assert_allclose(slope, expected, atol=1e-5 * np.abs(expected).max())
