"""
What mechanics says of a rod: the solutions that the simulator is checked against.

Frames and signs as everywhere: body x is the tangent, forces and moments are in the map frame.
"""

from __future__ import annotations

from continuum_loc import lie
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

FIRST_MODE = 1.8751040687119611  # least root of cos(x) cosh(x) = -1
LOAD_STEPS = 4  # the load grows in steps, each started from the last solution


def elastica_tip(force: float, EI: float, length: float) -> tuple[float, float]:
    """
    Tip (x, deflection) [m] of a weightless cantilever along x under a force [N].

    The force acts across the undeformed axis.

    Bisshopp and Drucker (1945): F(pi/2, k) - F(phi, k) = L sqrt(P / EI), with sin phi = 1 / (k
    sqrt 2).
    """
    alpha = length * np.sqrt(force / EI)

    def start(m: float) -> float:
        return np.arcsin(1.0 / np.sqrt(2.0 * m))

    m = brentq(
        lambda m: ellipk(m) - ellipkinc(start(m), m) - alpha, 0.5 + 1e-15, 1.0 - 1e-13, xtol=1e-16
    )
    deflection = length * (1.0 - 2.0 / alpha * (ellipe(m) - ellipeinc(start(m), m)))
    return length * np.sqrt(2.0 * (2.0 * m - 1.0)) / alpha, deflection


def first_frequency(EI: float, mass_per_metre: float, length: float) -> float:
    """First bending frequency [Hz] of an Euler-Bernoulli cantilever without gravity."""
    return (FIRST_MODE / length) ** 2 * np.sqrt(EI / mass_per_metre) / (2.0 * np.pi)


def cosserat_shape(
    s: np.ndarray,
    length: float,
    EI: float,
    GJ: float,
    EA: float = np.inf,
    weight: float = 0.0,
    tip_force=(0.0, 0.0, 0.0),
    tip_moment=(0.0, 0.0, 0.0),
    T_map_base: np.ndarray | None = None,
) -> np.ndarray:
    """
    (S, 4, 4) static poses of an unshearable rod clamped at s = 0, at arclengths s (S,) [m].

    weight: N per unstretched metre, along -z. Solves p' = R (1 + n.t / EA) e1, R' = R hat(K^-1 R^T
    m), n' = weight z, m' = n x p' by shooting on the base moment. Raises ValueError if that does
    not converge.
    """
    T_map_base = np.eye(4) if T_map_base is None else T_map_base
    compliance = np.array([1.0 / GJ, 1.0 / EI, 1.0 / EI])
    force, moment = np.asarray(tip_force, float), np.asarray(tip_moment, float)

    def slope(share: float):
        def of(at: float, y: np.ndarray) -> np.ndarray:
            R, m = y[3:12].reshape(3, 3), y[12:]
            n = share * (force - weight * (length - at) * np.array([0.0, 0.0, 1.0]))
            tangent = (1.0 + n @ R[:, 0] / EA) * R[:, 0]
            return np.concatenate(
                [tangent, (R @ lie.hat(compliance * (R.T @ m))).ravel(), np.cross(n, tangent)]
            )

        return of

    def integrate(
        base_moment: np.ndarray, share: float, at: np.ndarray | None = None
    ) -> np.ndarray:
        y = np.concatenate([T_map_base[:3, 3], T_map_base[:3, :3].ravel(), base_moment])
        return solve_ivp(
            slope(share), (0.0, length), y, 'DOP853', t_eval=at, rtol=1e-9, atol=1e-11
        ).y

    base_moment = np.zeros(3)
    for share in np.linspace(0.0, 1.0, LOAD_STEPS + 1)[1:]:
        solved = root(
            lambda m, share=share: integrate(m, share)[12:, -1] - share * moment,
            base_moment,
            tol=1e-10,
        )
        if not solved.success and np.abs(solved.fun).max() > 1e-8:
            raise ValueError(f'no static shape found at {share:.0%} of the load: {solved.message}')
        base_moment = solved.x
    y = integrate(base_moment, 1.0, np.asarray(s, float))
    T = np.zeros((y.shape[1], 4, 4))
    T[:, :3, 3], T[:, :3, :3], T[:, 3, 3] = y[:3].T, y[3:12].T.reshape(-1, 3, 3), 1.0
    return T
