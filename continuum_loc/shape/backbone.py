"""
All modules at once.

One smooth, inextensible backbone that explains every field and every attitude.

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

from continuum_loc import lie_kernels
from continuum_loc.magnet import evaluate_field, FieldModel, magnet_parameters
from continuum_loc.robot import RobotDescription
from numba import njit
import numpy as np

MAX_ITERATIONS = 50
PIECES = 3


@dataclass(frozen=True, slots=True, eq=False)
class BackboneFit:
    """
    The joint fit of all modules.

    T_base_module (M, 4, 4); covariance (M, 6, 6) of a right perturbation [rho; phi]; strain (N,
    3): twist and the two curvatures of the N = PIECES * M arcs [1/m]; cost: half the sum of
    squares; dimension: of the measurements in it; converged.
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
        """
        Set how much the curvature changes from one module to the next.

        step_sigma: 1 sigma of the change [1/m].
        """
        gaps = np.diff(np.asarray(arclengths, float), prepend=0.0)
        self.lengths = np.repeat(gaps / PIECES, PIECES)
        self.parameters = magnet_parameters(robot.magnet, model)
        self.magnet_s = robot.magnet.s
        self.rest = np.array(robot.backbone.rest_strain[3:])
        sigma = np.array(robot.backbone.rest_strain_sigma[3:])
        # The prior on the strain (its mean from module to module) and on the curvature's walk from
        # arc to arc.
        count = len(self.lengths)
        step = np.diff(np.eye(count), axis=0)
        walk = PIECES / step_sigma**2
        weights = [
            np.kron(np.eye(count), np.diag(sigma**-2.0)) / PIECES,
            np.kron(step.T @ step, np.diag([0.0, walk, walk])),
        ]
        self.prior = np.ascontiguousarray(sum(weights))

    def solve(
        self,
        field: np.ndarray,
        field_sigma: np.ndarray,
        earth: np.ndarray,
        R_base_module: np.ndarray,
        information: np.ndarray,
        start: np.ndarray | None = None,
    ) -> BackboneFit:
        """
        Fit to the fields in the modules' frames and to their attitudes.

        field (M, 3) [T] with sigma (M, 3) (inf drops a component), the Earth's field (3,) [T] in
        the base frame, and attitudes R_base_module (M, 3, 3) with information (M, 3, 3) [1/rad^2]
        in the modules' frames (zeros drop one). start: strain (N, 3) of an earlier fit.
        """
        strain = (
            np.tile(self.rest, (len(self.lengths), 1))
            if start is None
            else np.array(start, dtype=float)
        )
        weight = 1.0 / np.asarray(field_sigma, float) ** 2
        measured = np.where(weight > 0.0, field, 0.0)
        known = (
            measured,
            weight,
            np.asarray(earth, float),
            np.ascontiguousarray(R_base_module),
            np.ascontiguousarray(information),
        )
        T, chain, H, cost, converged = _solve(
            strain, self.lengths, self.parameters, self.magnet_s, self.rest, self.prior, *known
        )
        # The posterior of the strains, carried along the chain to every module.
        covariance = chain @ np.linalg.solve(H, chain.swapaxes(1, 2))
        dimension = int((weight > 0.0).sum() + np.linalg.matrix_rank(information).sum())
        return BackboneFit(T, covariance, strain, cost, dimension, converged)


@njit(cache=True)
def _solve(
    strain,
    lengths,
    parameters,
    magnet_s,
    rest,
    prior,
    field,
    weight,
    earth,
    R_measured,
    information,
):
    """Levenberg-Marquardt on `strain` (N, 3), in place."""
    count = 3 * lengths.size
    T, chain = _forward(strain, lengths)
    H, slope, cost = _normal(
        T,
        chain,
        strain,
        parameters,
        magnet_s,
        rest,
        prior,
        field,
        weight,
        earth,
        R_measured,
        information,
    )
    damping, converged = 1e-6, False
    for _ in range(MAX_ITERATIONS):
        damped = H.copy()
        for i in range(count):
            damped[i, i] *= 1.0 + damping
        step = -np.linalg.solve(damped, slope)
        trial = strain + step.reshape(strain.shape)
        T_trial, chain_trial = _forward(trial, lengths)
        H_trial, slope_trial, cost_trial = _normal(
            T_trial,
            chain_trial,
            trial,
            parameters,
            magnet_s,
            rest,
            prior,
            field,
            weight,
            earth,
            R_measured,
            information,
        )
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


@njit(cache=True)
def _forward(strain, lengths):
    """
    T_base_module (M, 4, 4), and its right-perturbation Jacobian by all strains.

    The Jacobian is chain (M, 6, 3 N).
    """
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


@njit(cache=True)
def _normal(
    T,
    chain,
    strain,
    parameters,
    magnet_s,
    rest,
    prior,
    field,
    weight,
    earth,
    R_measured,
    information,
):
    """Gauss-Newton matrix, gradient and cost of the whole fit."""
    departure = (strain - rest).ravel()
    H = prior.copy()
    slope = prior @ departure
    cost = 0.5 * (departure * slope).sum()
    J = np.empty((3, 6))
    residual = np.empty(3)
    for m in range(T.shape[0]):
        field_error(T[m], parameters, magnet_s, earth, field[m], residual, J)
        rows = J @ chain[m]
        for i in range(3):
            if weight[m, i] > 0.0:
                cost += 0.5 * weight[m, i] * residual[i] ** 2
                slope += weight[m, i] * residual[i] * rows[i]
                H += weight[m, i] * np.outer(rows[i], rows[i])
        turn = rotation_difference(R_measured[m], T[m])
        rows = np.ascontiguousarray(chain[m, 3:])
        pull = information[m] @ turn
        cost += 0.5 * (turn * pull).sum()
        slope += rows.T @ pull
        H += rows.T @ (information[m] @ rows)
    return H, slope, cost


@njit(cache=True)
def field_error(T_base_module, parameters, magnet_s, earth, measured, residual, J):
    """
    Residual (3,) = R^T (B(p) + earth) - measured [T], and its Jacobian J (3, 6).

    By a right perturbation [rho; phi].
    """
    R = T_base_module[:3, :3]
    p = T_base_module[:3, 3].copy()
    p[0] -= magnet_s
    source, gradient = np.empty(3), np.empty((3, 3))
    evaluate_field(parameters, p, source, gradient)
    h = np.zeros(3)
    for i in range(3):
        for j in range(3):
            h[i] += R[j, i] * (source[j] + earth[j])
    for i in range(3):
        residual[i] = h[i] - measured[i]
        for j in range(3):
            total = 0.0
            for k in range(3):
                for n in range(3):
                    total += R[k, i] * gradient[k, n] * R[n, j]
            J[i, j] = total
    # d(R^T w) = [h]x phi
    J[0, 3], J[0, 4], J[0, 5] = 0.0, -h[2], h[1]
    J[1, 3], J[1, 4], J[1, 5] = h[2], 0.0, -h[0]
    J[2, 3], J[2, 4], J[2, 5] = -h[1], h[0], 0.0


@njit(cache=True)
def rotation_difference(R_measured, T):
    """(3,) Log(R_measured^T R)."""
    D = np.zeros((4, 4))
    D[3, 3] = 1.0
    D[:3, :3] = np.ascontiguousarray(R_measured.T) @ np.ascontiguousarray(T[:3, :3])
    x = np.empty(6)
    lie_kernels.log(D, x)
    return x[3:]
