"""
All modules at once: one smooth, inextensible backbone that explains every field and attitude.

The backbone is a chain of arcs of constant twist and curvature, `PIECES` from each module to the
next, so that arclengths hold exactly and neighbours share what they know. Against solving eq. 10
module by module, a module whose field says little (far away, on the equatorial plane, saturated)
is held by the others.

    minimise  sum |R^T (B(p) + b_earth) - b|^2 / sigma^2      (field, module's frame; no attitude)
            + sum |Log(R_imu^T R)|^2_P                        (attitude, yaw loose)
            + sum |strain - rest|^2 / sigma_rest^2 + sum |curvature step|^2 / sigma_step^2
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from continuum_loc import lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.magnet import field_error, FieldModel, magnet_parameters, MagnetParameters
from continuum_loc.robot import RobotDescription
import numpy as np

MAX_ITERATIONS = 50
PIECES = 3


class Rod(NamedTuple):
    """What is known before any reading: the chain of N arcs, its priors, and the magnet."""

    lengths: np.ndarray  # (N,) of the arcs [m]
    rest: np.ndarray  # (3,) strain without load [1/m]
    prior: np.ndarray  # (3 N, 3 N) information of the strains [m^2]
    magnet: MagnetParameters
    magnet_s: float  # arclength of the magnet's centre [m]


class Readings(NamedTuple):
    """What M modules read; the fields in their own frames."""

    field: np.ndarray  # (M, 3) [T]
    weight: np.ndarray  # (M, 3) of its components [1/T^2]; 0 drops one
    earth: np.ndarray  # (3,) in the base frame [T]
    R_base_module: np.ndarray  # (M, 3, 3)
    information: np.ndarray  # (M, 3, 3) of the rotations [1/rad^2]; zeros drop one


@dataclass(frozen=True, slots=True, eq=False)
class BackboneFit:
    """
    The joint fit of all modules.

    T_base_module: (M, 4, 4). covariance: (M, 6, 6) of a right perturbation [rho; phi].
    strain: (N, 3) twist and the two curvatures [1/m] of the N = PIECES * M arcs.
    cost: half the sum of squares. dimension: how many measurements it sums over.
    """

    T_base_module: np.ndarray
    covariance: np.ndarray
    strain: np.ndarray
    cost: float
    dimension: int
    converged: bool

    @property
    def consistency(self) -> float:
        """Sum of squared residuals per measured dimension: about 1 or less for an honest fit."""
        return 2.0 * self.cost / max(self.dimension, 1)


class BackboneSolver:
    """The joint fit for the modules at `arclengths` (M,) [m] from the base of `robot`."""

    def __init__(
        self,
        robot: RobotDescription,
        arclengths: np.ndarray,
        model: FieldModel = 'ring',
        step_sigma: float = 15.0,
    ) -> None:
        """step_sigma: how much the curvature changes between neighbours, 1 sigma [1/m]."""
        gaps = np.diff(np.asarray(arclengths, float), prepend=0.0)
        lengths = np.repeat(gaps / PIECES, PIECES)
        sigma = np.array(robot.backbone.rest_strain_sigma[3:])
        # The mean strain between two modules is near the rest strain, and the curvature walks
        # from arc to arc.
        count = len(lengths)
        step = np.diff(np.eye(count), axis=0)
        walk = PIECES / step_sigma**2
        weights = [
            np.kron(np.eye(count), np.diag(sigma**-2.0)) / PIECES,
            np.kron(step.T @ step, np.diag([0.0, walk, walk])),
        ]
        self.rod = Rod(
            lengths,
            np.array(robot.backbone.rest_strain[3:]),
            np.ascontiguousarray(sum(weights)),
            magnet_parameters(robot.magnet, model),
            robot.magnet.s,
        )

    def solve(
        self,
        field: np.ndarray,
        field_sigma: np.ndarray,
        earth: np.ndarray,
        R_base_module: np.ndarray,
        information: np.ndarray,
        iterations: int = MAX_ITERATIONS,
    ) -> BackboneFit:
        """
        Fit to the fields in the modules' frames and to their attitudes.

        The arguments are those of `Readings`, with field_sigma (M, 3) [T] for the weights: inf
        drops a component. iterations: at most so many.
        """
        weight = 1.0 / np.asarray(field_sigma, float) ** 2
        readings = Readings(
            np.where(weight > 0.0, field, 0.0),
            weight,
            np.asarray(earth, float),
            np.ascontiguousarray(R_base_module),
            np.ascontiguousarray(information),
        )
        strain = np.tile(self.rod.rest, (len(self.rod.lengths), 1))
        T, chain, H, cost, converged = _solve(strain, self.rod, readings, iterations)
        # The posterior of the strains, carried along the chain to every module.
        covariance = chain @ np.linalg.solve(H, chain.swapaxes(1, 2))
        dimension = int((weight > 0.0).sum() + np.linalg.matrix_rank(information).sum())
        return BackboneFit(T, covariance, strain, cost, dimension, converged)


@kernel
def _solve(strain, rod, readings, iterations):
    """Levenberg-Marquardt on `strain` (N, 3), in place."""
    T, chain = _forward(strain, rod.lengths)
    H, slope, cost = _normal(T, chain, strain, rod, readings)
    damping, converged = 1e-6, False
    for _ in range(iterations):
        damped = H.copy()
        for i in range(slope.size):
            damped[i, i] *= 1.0 + damping
        step = -np.linalg.solve(damped, slope)
        trial = strain + step.reshape(strain.shape)
        T_trial, chain_trial = _forward(trial, rod.lengths)
        H_trial, slope_trial, cost_trial = _normal(T_trial, chain_trial, trial, rod, readings)
        promised = -0.5 * (slope * step).sum()
        if cost_trial <= cost:
            strain[:] = trial
            T, chain, H, slope, cost = T_trial, chain_trial, H_trial, slope_trial, cost_trial
            damping = max(damping / 10.0, 1e-12)
        else:
            damping *= 10.0
        if promised < 1e-9 * (1.0 + cost) or damping > 1e12:
            converged = promised < 1e-6 * (1.0 + cost)
            break
    return T, chain, H, cost, converged


@kernel
def _forward(strain, lengths):
    """Give T_base_module (M, 4, 4) and its right-perturbation Jacobian (M, 6, 3 N) by strain."""
    arcs = lengths.size
    T = np.zeros((arcs, 4, 4))
    chain = np.zeros((arcs, 6, 3 * arcs))
    xi, c, dc = np.zeros(6), np.empty(5), np.empty(5)
    arc, back = np.empty((4, 4)), np.empty((4, 4))
    A, J, work, carry = np.empty((6, 6)), np.empty((6, 6)), np.empty((2, 6, 6)), np.empty((6, 6))
    identity = np.eye(4)
    for n in range(arcs):
        xi[0] = lengths[n]
        for i in range(3):
            xi[3 + i] = lengths[n] * strain[n, i]
        lie_kernels.exp(xi, arc)
        lie_kernels.compose(T[n - 1] if n > 0 else identity, arc, T[n])
        lie_kernels.relative(arc, identity, back)
        lie_kernels.adjoint(back, carry)  # Ad(arc^-1) brings the previous arc's perturbation here
        if n > 0:
            chain[n] = carry @ chain[n - 1]
        lie_kernels.ad(xi, A)
        lie_kernels.right_coefficients(xi, c, dc)
        lie_kernels.polynomial(c, A, J, work)
        start, end = 3 * n, 3 * (n + 1)
        chain[n, :, start:end] = lengths[n] * J[:, 3:]
    first = PIECES - 1
    return T[first::PIECES].copy(), chain[first::PIECES].copy()


@kernel
def _normal(T, chain, strain, rod, readings):
    """Gauss-Newton matrix, gradient and cost of the whole fit."""
    departure = (strain - rod.rest).ravel()
    H = rod.prior.copy()
    slope = rod.prior @ departure
    cost = 0.5 * (departure * slope).sum()
    J = np.empty((3, 6))
    residual = np.empty(3)
    for m in range(T.shape[0]):
        p = T[m, :3, 3].copy()
        p[0] -= rod.magnet_s
        field_error(rod.magnet, T[m, :3, :3], p, readings.earth, readings.field[m], residual, J)
        rows = J @ chain[m]
        for i in range(3):
            weight = readings.weight[m, i]
            if weight > 0.0:
                cost += 0.5 * weight * residual[i] ** 2
                slope += weight * residual[i] * rows[i]
                H += weight * np.outer(rows[i], rows[i])
        turn = _rotation_difference(readings.R_base_module[m], T[m])
        rows = np.ascontiguousarray(chain[m, 3:])
        pull = readings.information[m] @ turn
        cost += 0.5 * (turn * pull).sum()
        slope += rows.T @ pull
        H += rows.T @ (readings.information[m] @ rows)
    return H, slope, cost


@kernel
def _rotation_difference(R_measured, T):
    """(3,) Log(R_measured^T R)."""
    D = np.zeros((4, 4))
    D[3, 3] = 1.0
    D[:3, :3] = np.ascontiguousarray(R_measured.T) @ np.ascontiguousarray(T[:3, :3])
    x = np.empty(6)
    lie_kernels.log(D, x)
    return x[3:]
