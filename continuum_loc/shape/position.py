"""
Where a module is, from the field it measures: the paper's bounded least squares (eq. 10).

    min |b - B(p)|^2   subject to   lower <= p <= upper,

p in the magnet's frame (axis x), B the dipole or the ring of `magnet`. B(-p) = B(p), so the bounds
keep p on the side that the robot is on; there the dipole has one solution only, except on the
equatorial plane, where the gradient loses a rank. Where starts still end in different optima that
fit alike, the one nearest to the prior is taken and the module is marked ambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from continuum_loc.compiling import kernel
from continuum_loc.errors import MeasurementError
from continuum_loc.magnet import (
    evaluate_field,
    field_and_gradient,
    FieldModel,
    invert_dipole,
    invert_dipole_once,
    magnet_parameters,
)
from continuum_loc.robot import Magnet
import numpy as np

MAX_ITERATIONS = 60
STEP_TOLERANCE = 1e-11  # m
SAME_OPTIMUM = 1e-5  # m: closer ends of two starts are one optimum


@dataclass(frozen=True, slots=True, eq=False)
class PositionFit:
    """
    Positions of M modules in the magnet's frame.

    position: (M, 3) [m]. bound: (M, 3) int, -1 on the lower bound, 1 on the upper, 0 inside.
    converged: (M,) whether the first-order (KKT) conditions hold: the gradient is zero on every
    free axis and points out of the box on every bound axis.
    ambiguous: (M,) whether another optimum fits as well.
    """

    position: np.ndarray
    bound: np.ndarray
    converged: np.ndarray
    ambiguous: np.ndarray


class PositionSolver:
    """
    Eq. 10 for modules at known arclengths [m] from the magnet.

    The bounds are a box: no module is farther from the magnet than its arclength, and it lies on
    the magnet's positive side.
    """

    def __init__(
        self,
        magnet: Magnet,
        arclengths: np.ndarray,
        model: FieldModel = 'ring',
        slack: float = 1.05,
    ) -> None:
        self.magnet, self.model = magnet, model
        self.parameters = magnet_parameters(magnet, model)
        self.arclengths = np.asarray(arclengths, float)
        reach = slack * self.arclengths[:, None]
        self.lower = np.concatenate([np.zeros_like(reach), -reach, -reach], axis=1)
        self.upper = np.concatenate([reach, reach, reach], axis=1)

    def solve(self, field: np.ndarray, start: np.ndarray | None = None) -> PositionFit:
        """
        Positions from `field` (M, 3) [T] in the magnet's frame.

        start: (M, 3) prior positions [m], by default the closed-form inverse of the dipole.
        Raises MeasurementError for a field that is not finite: a saturated module has no position
        of its own.
        """
        field = np.ascontiguousarray(field, dtype=float)
        if field.shape != self.lower.shape or not np.isfinite(field).all():
            raise MeasurementError(
                'saturated',
                f'expected a finite field of shape {self.lower.shape}, got {field.tolist()}',
            )
        prior = (
            invert_dipole(self.magnet, field)
            if start is None
            else np.ascontiguousarray(start, dtype=float)
        )
        return PositionFit(*_solve_all(self.parameters, field, prior, self.lower, self.upper))

    def field(self, position: np.ndarray) -> np.ndarray:
        """(M, 3) field [T] of the model at `position` (M, 3) [m]."""
        return field_and_gradient(self.magnet, position, self.model)[0]

    def covariance(
        self,
        position: np.ndarray,
        field: np.ndarray,
        sigma: float,
        attitude: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        (M, 6, 6) covariance of position and attitude errors, and observability (M,).

        Both are in the magnet's frame. sigma: white noise of the field [T]. attitude: (M, 3, 3)
        covariance [rad^2] of the module's rotation error phi, which turns the measured field by
        db = phi x b. The prior that a module lies within its arclength (one sigma is half of it)
        keeps the result finite where the field says nothing. A position is observable where the
        field narrows that prior at least fivefold in every direction.
        """
        return _covariance(
            self.parameters,
            np.ascontiguousarray(position),
            np.ascontiguousarray(field),
            sigma**2,
            np.ascontiguousarray(attitude),
            0.5 * self.arclengths,
        )


@kernel
def _covariance(magnet, position, field, variance, attitude, prior_sigma):
    modules = len(position)
    covariance = np.empty((modules, 6, 6))
    observable = np.empty(modules, np.bool_)
    source, gradient, turn = np.empty(3), np.empty((3, 3)), np.zeros((3, 3))
    for m in range(modules):
        evaluate_field(magnet, position[m], source, gradient)
        b = field[m]
        turn[0, 1], turn[0, 2], turn[1, 2] = b[2], -b[1], b[0]  # db = phi x b
        turn[1, 0], turn[2, 0], turn[2, 1] = -b[2], b[1], -b[0]
        noise = variance * np.eye(3) + turn @ attitude[m] @ turn.T
        weighted = np.linalg.solve(noise, gradient).T
        P = np.linalg.inv(weighted @ gradient + np.eye(3) / prior_sigma[m] ** 2)
        cross = P @ weighted @ turn @ attitude[m]  # a turned field moves the solution
        covariance[m, :3, :3], covariance[m, 3:, 3:] = P, attitude[m]
        covariance[m, :3, 3:], covariance[m, 3:, :3] = cross, cross.T
        observable[m] = np.linalg.eigvalsh(P)[2] < (0.2 * prior_sigma[m]) ** 2
    return covariance, observable


@kernel
def _solve_all(magnet, fields, prior, lower, upper):
    """Position (M, 3), bound (M, 3), converged (M,) and ambiguous (M,) of all modules."""
    modules = fields.shape[0]
    position = np.empty((modules, 3))
    bound = np.zeros((modules, 3), np.int64)
    converged = np.zeros(modules, np.bool_)
    ambiguous = np.zeros(modules, np.bool_)
    for m in range(modules):
        position[m], converged[m], ambiguous[m] = _solve_module(
            magnet, fields[m], prior[m], lower[m], upper[m]
        )
        for i in range(3):
            if position[m, i] <= lower[m, i]:
                bound[m, i] = -1
            elif position[m, i] >= upper[m, i]:
                bound[m, i] = 1
    return position, bound, converged, ambiguous


@kernel
def _solve_module(magnet, measured, prior, lower, upper):
    """
    Start from the prior, and then from the dipole's closed form and its mirror image.

    An exact fit inside the box needs no further start: the field has one source position there.
    """
    position, best, converged = _solve_one(magnet, measured, prior, lower, upper)
    ambiguous = False
    if converged and best < 1e-16:
        return position, converged, ambiguous
    for side in (1.0, -1.0):
        start = invert_dipole_once(magnet.dipole, measured) * side
        p, cost, stationary = _solve_one(magnet, measured, start, lower, upper)
        # An alternative replaces the prior's own optimum only by fitting clearly better.
        if cost < 0.25 * best - 1e-16:
            position, best, converged, ambiguous = p, cost, stationary, False
        elif math.sqrt(((p - position) ** 2).sum()) > SAME_OPTIMUM and cost <= 4.0 * best + 1e-16:
            ambiguous = True
    return position, converged, ambiguous


@kernel
def _solve_one(magnet, measured, start, lower, upper):
    """Levenberg-Marquardt with an active set; the cost is |B(p) - b|^2 / |b|^2."""
    p = np.minimum(np.maximum(start, lower), upper)
    size = math.sqrt((measured**2).sum())
    field, trial_field = np.empty(3), np.empty(3)
    gradient, trial_gradient = np.empty((3, 3)), np.empty((3, 3))
    evaluate_field(magnet, p, field, gradient)
    cost = _relative_cost(field, measured, size)
    damping = 1e-6
    stationary = False
    for _ in range(MAX_ITERATIONS):
        step, reducible = _step(field, gradient, measured, size, p, lower, upper, damping)
        if reducible < 1e-24:
            stationary = True
            break
        trial = np.minimum(np.maximum(p + step, lower), upper)
        moved = math.sqrt(((trial - p) ** 2).sum())
        evaluate_field(magnet, trial, trial_field, trial_gradient)
        trial_cost = _relative_cost(trial_field, measured, size)
        if trial_cost <= cost:
            p = trial
            cost = trial_cost
            field[:] = trial_field
            gradient[:] = trial_gradient
            damping = max(damping / 10.0, 1e-12)
            if moved < STEP_TOLERANCE:
                stationary = True
                break
        else:
            damping *= 10.0
            if damping > 1e12:
                stationary = moved < STEP_TOLERANCE
                break
    return p, cost, stationary


@kernel
def _relative_cost(field, measured, size):
    total = 0.0
    for i in range(3):
        total += ((field[i] - measured[i]) / size) ** 2
    return total


@kernel
def _step(field, gradient, measured, size, p, lower, upper, damping):
    """Damped Gauss-Newton step of the axes that are free, and the cost that it could remove."""
    slope = np.zeros(3)
    H = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            slope[i] += gradient[k, i] / size * (field[k] - measured[k]) / size
            for j in range(3):
                H[i, j] += gradient[k, i] / size * gradient[k, j] / size
    largest = max(H[0, 0], H[1, 1], H[2, 2])
    for i in range(3):
        held = (p[i] <= lower[i] and slope[i] > 0.0) or (p[i] >= upper[i] and slope[i] < 0.0)
        if held:
            H[i, :] = 0.0
            H[:, i] = 0.0
            H[i, i] = largest
            slope[i] = 0.0
        H[i, i] += damping * (H[i, i] + 1e-9 * largest)
    step = _solve3(H, -slope)
    return step, -(slope * step).sum()


@kernel
def _solve3(H, b):
    """Solve the symmetric positive 3x3 system H x = b by Cholesky, in place."""
    x = b.copy()
    for i in range(3):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            H[i, j] = math.sqrt(max(total, 1e-300)) if i == j else total / H[j, j]
    for i in range(3):
        for k in range(i):
            x[i] -= H[i, k] * x[k]
        x[i] /= H[i, i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            x[i] -= H[k, i] * x[k]
        x[i] /= H[i, i]
    return x
