"""
What the body touches: forces that its tendons and its weight do not explain.

The shape that was estimated is put into the statics (`mechanics`): what is left of the forces in
each element, Q = elastic + tendons - weight - inertia, is what forces from outside have to hold. A
force f at a node makes Q = A f, with A the motion of that node by the strain, so that the best
force at every node is a linear fit; the node at which it explains most is told, if it explains
enough, and the next one is looked for in what is left.

Q is uncertain by the estimated strain (its covariance by the tangent stiffness) and by the
statics' own spread, `strain_sigma`.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.estimate import PointLoad
from continuum_loc.estimator.factors.base import Setup
from continuum_loc.estimator.factors.mechanics import MechanicsFactor
from continuum_loc.estimator.interpolation import Body
from continuum_loc.estimator.state import NODE_DIM
from continuum_loc.estimator.window import Window
from continuum_loc.mechanics.body import TendonBody
from continuum_loc.mechanics.statics import assemble, new_balance
from continuum_loc.plausible import GRAVITY
import numpy as np

STRAINS = (0, 3, 4, 5)  # of a relative twist: stretch, twist, bending
MOST = 3  # forces at a time
ALONG, ACROSS = 0.3, 100.0  # [N] spread of a force before anything is known
ACCELERATION_SPAN = 0.2  # [s] over which the body's acceleration is taken


class Misfit(NamedTuple):
    """Unexplained forces of the elements: Q (F,) of free strains, the motions A, information."""

    Q: np.ndarray
    A: np.ndarray  # (N, F, 3) of the nodes 1 to N
    information: np.ndarray  # (F, F)


class Loads:
    """Looks for forces on the body of one robot in the newest estimate."""

    def __init__(self, setup: Setup, window: Window, factor: MechanicsFactor) -> None:
        self._window, self._factor, self._options = window, factor, setup.settings.mechanics
        self._grid = setup.grid
        self._body = TendonBody(setup.robot, setup.grid.s)
        count = len(self._body.s)
        self._balance = new_balance(count, len(setup.robot.actuation.tendons))
        self._memory = self._body.rod.rest[:, 2:].copy()
        free = np.isfinite(self._body.rod.stiffness).ravel()
        self._free = np.flatnonzero(free)
        sigma = np.array(setup.robot.actuation.strain_sigma)[[0, 1, 1, 2]]
        self._spread = np.tile(sigma, count)[self._free]
        self._mass = _node_masses(self._body)
        self._looked = -np.inf
        self.found: tuple[PointLoad, ...] = ()

    def look(self, time: float) -> None:
        """Judge the body at `time` [s], if it is time."""
        if not self._options.loads or time - self._looked < self._options.load_period:
            return
        motors = self._factor.motors
        if motors is None or time - ACCELERATION_SPAN < self._window.columns[0].time:
            return
        self._looked = time
        body = self._window.body(time)
        self.found = self._explain(self._misfit(time, body, motors), body)

    def _misfit(self, time: float, body: Body, motors: np.ndarray) -> Misfit:
        before = self._window.body(time - ACCELERATION_SPAN)
        push = -self._mass[:, None] * (_speed(body) - _speed(before)) / ACCELERATION_SPAN
        load = self._body.load._replace(force=push)
        spans, balance, free = self._body.rod.spans, self._balance, self._free
        twist = lie.log(lie.inverse(body.T[:-1]) @ body.T[1:]) / spans[:, None]
        strain = np.ascontiguousarray(twist[:, STRAINS] - [1.0, 0.0, 0.0, 0.0])
        balance.T[0] = body.T[0]
        tendons = self._body.pulled(motors)
        assemble(self._body.rod, tendons, load, self._memory, strain, balance)
        H = balance.tangent[np.ix_(free, free)]
        covariance = self._strain_covariance(time, twist)[np.ix_(free, free)]
        covariance += np.diag(self._spread**2)
        return Misfit(
            balance.residual[free].copy(),
            _motions(balance)[:, free],
            np.linalg.inv(H @ covariance @ H.T),
        )

    def _strain_covariance(self, time: float, twist: np.ndarray) -> np.ndarray:
        """Covariance (4 N, 4 N) of the elements' mean strain."""
        k = self._window.knot_before(time)
        a, b = self._window.columns[k].time, self._window.columns[k + 1].time
        u = (time - a) / (b - a)
        h = self._body.rod.spans
        J = np.zeros((len(h), 4, self._grid.dim))
        by_last = np.einsum('nij,n->nij', lie.right_jacobian_inverse(twist * h[:, None]), 1.0 / h)
        by_first = -by_last @ lie.adjoint(lie.exp(-twist * h[:, None]))
        for n in range(len(h)):
            first, last = NODE_DIM * n, NODE_DIM * n + NODE_DIM
            J[n][:, first:][:, :6] = by_first[n, STRAINS]
            J[n][:, last:][:, :6] = by_last[n, STRAINS]
        J = J.reshape(-1, self._grid.dim)
        return self._window.chain.covariance(k, (1.0 - u) * J, u * J)

    def _explain(self, misfit: Misfit, body: Body) -> tuple[PointLoad, ...]:
        Q, found = misfit.Q.copy(), []
        for _ in range(MOST):
            gains, forces, covariances = _fits(Q, misfit, body.T[1:, :3, 0])
            node = int(np.argmax(gains))
            if gains[node] < self._options.load_evidence:
                break
            Q = Q - misfit.A[node] @ forces[node]
            if np.linalg.norm(forces[node]) < self._options.least_force:
                break
            place, spread = _place(self._grid.s[1:], gains)
            found.append(
                PointLoad(
                    place, spread, body.T[1 + node, :3, 3].copy(), forces[node], covariances[node]
                )
            )
        return tuple(found)


def _fits(
    Q: np.ndarray, misfit: Misfit, tangent: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    At each node: how much a force there explains (N,), the force (N, 3), its covariance.

    Along the body (tangent (N, 3)) a force bends it little: there it is taken for the friction of
    a contact, ALONG, and across it for anything within ACROSS.
    """
    weighted = misfit.information @ misfit.A  # (N, F, 3)
    along = tangent[:, :, None] * tangent[:, None, :]
    H = misfit.A.transpose(0, 2, 1) @ weighted
    H += along * (ALONG**-2 - ACROSS**-2) + ACROSS**-2 * np.eye(3)
    g = np.einsum('nfi,f->ni', weighted, Q)
    covariance = np.linalg.inv(H)
    force = np.einsum('nij,nj->ni', covariance, g)
    return np.einsum('ni,ni->n', g, force), force, covariance


def _place(s: np.ndarray, gains: np.ndarray) -> tuple[float, float]:
    """Arclength of the greatest gain, between nodes by a parabola, and its standard deviation."""
    n = int(np.argmax(gains))
    if n in (0, len(s) - 1):
        m = 1 if n == 0 else n - 1
        slope = abs(gains[n] - gains[m]) / abs(s[n] - s[m])
        return float(s[n]), float(1.0 / max(slope, 1e-9))
    around = slice(n - 1, n + 2)
    fit = np.polyfit(s[around] - s[n], gains[around], 2)
    top = s[n] - fit[1] / (2.0 * fit[0]) if fit[0] < 0.0 else s[n]
    # The gain is twice the logarithm of the likelihood.
    spread = 1.0 / np.sqrt(max(-fit[0], 1e-9))
    return float(np.clip(top, s[n - 1], s[n + 1])), float(spread)


def _motions(balance) -> np.ndarray:
    """(N, 4 N, 3) how the nodes 1 to N move by the strain: zero by that of elements beyond."""
    count = len(balance.motions)
    own = balance.motions.reshape(4 * count, 6)
    places = balance.T[1:, :3, 3]
    moved = own[None, :, :3] + np.cross(own[None, :, 3:], places[:, None, :])
    beyond = np.arange(4 * count)[None, :] // 4 > np.arange(count)[:, None]
    return np.where(beyond[..., None], 0.0, moved)


def _speed(body: Body) -> np.ndarray:
    """(N + 1, 3) velocities of the nodes in the map [m/s]."""
    return np.einsum('nij,nj->ni', body.T[:, :3, :3], body.velocity[:, :3])


def _node_masses(body: TendonBody) -> np.ndarray:
    """(N + 1,) masses at the nodes [kg], by the weight: half of each neighbour."""
    half = 0.5 * body.rod.spans * np.linalg.norm(body.load.weight) / GRAVITY
    return np.concatenate([[0.0], half]) + np.concatenate([half, [0.0]])
