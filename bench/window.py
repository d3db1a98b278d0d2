"""
Least squares over a window, beside gtsam.

`run(quick)` gives rows on one core, alternating the two; both sides give the same answer, which is
checked:
- *window, solve*: the engine robot's window of 1 s after 3 s of data (16 ToF x 64 zones, gyros,
  strain; all its factors and priors, linearised): from its normal equations to all offsets.
  gtsam is handed them as HessianFactors, made beforehand, in the order of time, once with a column
  of the window as one variable and once with a variable per node, in which it may find what is
  sparse; the faster of the two is its row.
- *window, solve and covariance*: and the covariance of the newest column.
- *temporal chain, Gauss-Newton*: one rigid body in the place of the robot, the motion prior
  between 6 knots and 240 frames at times between them, each a 6x6 information of the body's pose:
  four iterations from a poor guess. gtsam's package has neither this prior nor the interpolation,
  so that they enter as CustomFactors which call the very kernels that ours does: what this row
  compares is everything around them, gtsam's calls of Python included.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from bench.harness import one_core, seconds_of, side_by_side
from continuum_loc import lie, lie_kernels
from continuum_loc.estimator import gp
from continuum_loc.estimator.chain import Chain
from continuum_loc.estimator.normal import gather, new_normal, Normal, symmetric
from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.estimator.state import NODE_DIM
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import measured, Trial
from continuum_loc.robot import load_robot
from numba import njit
import numpy as np
from threadpoolctl import threadpool_limits

AGREEMENT = 1e-6  # relative, of the offsets; and of the chain's poses [m, rad]
KNOTS, FRAMES, ITERATIONS = 6, 240, 4
BODY = 12  # pose and velocity
TWIST = np.array([0.1, 0.02, -0.05, 0.3, -0.2, 0.1])  # of the body, and constant [m/s, rad/s]
SPREAD = np.array([0.02, 0.02, 0.02, 0.05, 0.05, 0.05])  # how far the poor guess is off [m, rad]


def run(quick: bool = False) -> list[dict]:
    """Rows of name, ours_s, peer, peer_s (seconds), ratio and spread."""
    repeats = 5 if quick else 25
    with one_core(), threadpool_limits(1):
        return [*_window_rows(repeats), _temporal_row(repeats)]


# ------------------------------------------------------------ the linear window


def _window_rows(repeats: int) -> list[dict]:
    start, blocks, nodes = _engine_window()
    dim, last = len(start.g), len(blocks)
    newest = np.eye(dim, order='F')

    def solve() -> list[np.ndarray]:
        return Chain(dim, start).solve(blocks, 0)

    def solve_and_covariance() -> tuple[np.ndarray, np.ndarray]:
        chain = Chain(dim, start)
        return chain.solve(blocks, 0)[-1], chain.covariance(last, newest)

    candidates = [_Gtsam(start, blocks, split) for split in ([0, dim], _per_node(nodes, dim))]
    for candidate in candidates:
        _require_close(candidate.solve(), np.concatenate(solve()), 'solution')
        _require_close(
            candidate.solve_and_covariance()[1], solve_and_covariance()[1], 'covariance'
        )
    peer = min(candidates, key=lambda one: seconds_of(one.solve, 5))
    return [
        side_by_side('window, solve', solve, 'gtsam', peer.optimise, repeats),
        side_by_side(
            'window, solve and covariance',
            solve_and_covariance,
            'gtsam',
            candidates[0].solve_and_covariance,
            repeats,
        ),
    ]


def _engine_window() -> tuple[Normal, list[Normal], int]:
    """Start and normal equations of the engine robot's window; its number of nodes."""
    settings = load_estimator_settings('engine')
    estimator = make_filter(load_robot('engine'), scene_map('S0'), settings)
    for sample in measured(Trial('engine', 'S0', 't2', duration=3.0)):
        estimator.process(sample)
    window = estimator.window
    return (
        window.chain.marginals[0],
        [interval.normal for interval in window.intervals],
        estimator.grid.nodes,
    )


def _per_node(nodes: int, dim: int) -> list[int]:
    """Bounds of the variables of a column: one per node, and its biases."""
    return [*range(0, NODE_DIM * nodes + 1, NODE_DIM), dim]


class _Gtsam:
    """The same quadratic as HessianFactors, each column split into variables at `bounds`."""

    def __init__(self, start: Normal, blocks: list[Normal], bounds: list[int]):
        import gtsam

        self._gtsam = gtsam
        self._per_column = len(bounds) - 1
        self._graph = gtsam.GaussianFactorGraph()
        self._columns = len(blocks) + 1
        pieces = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
        self._add(symmetric(start.H), start.g, 0, pieces)
        for k, block in enumerate(blocks):
            dim = bounds[-1]
            both = pieces + [slice(piece.start + dim, piece.stop + dim) for piece in pieces]
            self._add(symmetric(block.H), block.g, k * self._per_column, both)
        self._order = gtsam.Ordering()
        for key in range(self._columns * self._per_column):
            self._order.push_back(key)

    def _add(self, H: np.ndarray, g: np.ndarray, first: int, pieces: list[slice]) -> None:
        """Add a quadratic; gtsam minimises 1/2 x^T G x - x^T g."""
        make, H = self._gtsam.HessianFactor, np.asarray(H)
        if len(pieces) == 2:  # whole columns: the natural factor of an interval
            a, b = pieces
            self._graph.push_back(
                make(first, first + 1, H[a, a], H[a, b], -g[a], H[b, b], -g[b], 0.0)
            )
            return
        for i, a in enumerate(pieces):
            self._graph.push_back(make(first + i, H[a, a], -g[a], 0.0))
            for j, b in enumerate(pieces[:i]):
                if np.any(H[b, a]):
                    zero_b, zero_a = np.zeros_like(H[b, b]), np.zeros_like(H[a, a])
                    self._graph.push_back(
                        make(
                            first + j,
                            first + i,
                            zero_b,
                            H[b, a],
                            zero_b[0],
                            zero_a,
                            zero_a[0],
                            0.0,
                        )
                    )

    def optimise(self):
        return self._graph.optimize(self._order)

    def solve(self) -> np.ndarray:
        """All offsets, end to end."""
        values = self.optimise()
        return np.concatenate([values.at(key) for key in range(self._columns * self._per_column)])

    def solve_and_covariance(self) -> tuple[object, np.ndarray]:
        """Solve; the solution and the newest column's covariance."""
        tree = self._graph.eliminateMultifrontal(self._order)
        last = self._columns - 1
        if self._per_column > 1:
            return tree.optimize(), self._joint(tree)
        return tree.optimize(), tree.marginalCovariance(last)

    def _joint(self, tree) -> np.ndarray:
        n = self._per_column
        keys = list(range((self._columns - 1) * n, self._columns * n))
        return np.linalg.inv(self._graph.marginal(keys).hessian()[0])


def _require_close(theirs: np.ndarray, ours: np.ndarray, what: str) -> None:
    off = np.abs(theirs - ours).max() / np.abs(ours).max()
    if not off < AGREEMENT:
        raise RuntimeError(
            f'gtsam and we disagree on the {what} by {off:.1e} of its largest entry'
        )


# ------------------------------------------------------------ the temporal chain, not linear


def _temporal_row(repeats: int) -> dict:
    times, measured, information, guess, period = _temporal_problem()
    psd = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
    ours = lambda: _gauss_newton(times, measured, information, guess, period, psd)  # noqa: E731
    theirs = _gtsam_chain(times, measured, information, guess, period, psd)
    gap = np.abs(ours() - theirs()).max()
    if not gap < AGREEMENT:
        raise RuntimeError(f'the two chains end {gap:.1e} apart')
    return side_by_side(
        f'temporal chain, {ITERATIONS} Gauss-Newton iterations',
        ours,
        'gtsam, CustomFactor',
        theirs,
        max(repeats // 3, 3),
    )


def _temporal_problem():
    """Make up times, poses (F, 4, 4) and informations (F, 6, 6) of frames; guess; period [s]."""
    rng = np.random.default_rng(0)
    period = 1.0 / (KNOTS - 1)
    times = np.sort(rng.uniform(0.0, 1.0, FRAMES)).clip(1e-3, 1.0 - 1e-3)
    measured = lie.exp(times[:, None] * TWIST) @ lie.exp(1e-3 * rng.normal(size=(FRAMES, 6)))
    directions = rng.normal(size=(FRAMES, 64, 6))
    information = 1e3 * np.einsum('fzi,fzj->fij', directions, directions)
    knots = np.arange(KNOTS)[:, None] * period
    guess = lie.exp(knots * TWIST) @ lie.exp(SPREAD * rng.normal(size=(KNOTS, 6)))
    return times, measured, information, guess, period


def _gauss_newton(times, measured, information, guess, period, psd) -> np.ndarray:
    """Knot poses (K, 4, 4) after ITERATIONS, by the estimator's kernels and its chain."""
    T, v = guess.copy(), np.zeros((KNOTS, 6))
    start_T = guess[0].copy()
    knot = np.minimum((times / period).astype(np.int64), KNOTS - 2)
    frames = Frames(times - knot * period, knot, measured, information)
    H, g = np.empty((KNOTS - 1, 2 * BODY, 2 * BODY)), np.empty((KNOTS - 1, 2 * BODY))
    normal, work = Normal(H, g), gp.new_workspace()
    for _ in range(ITERATIONS):
        _linearise(T, v, period, 1 / psd, frames, normal, work)
        e = lie.log(lie.inverse(start_T) @ T[0])
        J = lie.right_jacobian_inverse(e)
        first = Normal(np.eye(BODY), np.concatenate([J.T @ e, v[0]]))
        first.H[:6, :6] = J.T @ J
        chain = Chain(BODY, first)
        offsets = np.array(chain.solve([Normal(h, b) for h, b in zip(H, g, strict=True)], 0))
        T, v = T @ lie.exp(offsets[:, :6]), v + offsets[:, 6:]
    return T


class Frames(NamedTuple):
    """Times after the knot before, that knot, poses (F, 4, 4) and informations (F, 6, 6)."""

    tau: np.ndarray
    knot: np.ndarray
    T: np.ndarray
    information: np.ndarray


@njit  # not cached: numba would not see that a kernel of the library has changed
def _linearise(T, v, period, q_inverse, frames, normal, work):
    index, product, local = np.arange(24), np.empty((6, 24)), new_normal(6)
    e, J = np.empty(12), np.empty((12, 24))
    normal.H[:] = 0.0
    normal.g[:] = 0.0
    for k in range(normal.g.shape[0]):
        gp.motion_error(gp.Ends(T[k], v[k], T[k + 1], v[k + 1], period), e, J, work)
        gp.add_motion(Normal(normal.H[k], normal.g[k]), index, e, J, period, q_inverse)
    for f in range(frames.tau.shape[0]):
        k, at = frames.knot[f], work[0]
        gp.relate(gp.Ends(T[k], v[k], T[k + 1], v[k + 1], period), work)
        gp.evaluate(work, frames.tau[f], True, 0)
        error, J_log = at.gamma, at.right_gamma
        lie_kernels.pose_error(frames.T[f], at.T, error, J_log, at.scratch)
        weighted = J_log.T @ frames.information[f]
        local.H[:] = weighted @ J_log
        local.g[:] = weighted @ error.x
        gather(Normal(normal.H[k], normal.g[k]), local, at.J_pose, product)


def _gtsam_chain(times, measured, information, guess, period, psd) -> Callable[[], np.ndarray]:
    """Pose the same problem to gtsam, whose Pose3 perturbs [rotation; translation]."""
    import gtsam

    swap = np.array([3, 4, 5, 0, 1, 2])
    pose, rate = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V
    work, e, J = gp.new_workspace(), np.empty(12), np.empty((12, 24))
    at = work[0]

    def ends(values, k: int) -> gp.Ends:
        T, v = (
            [one(key(k + i)) for i in range(2)]
            for one, key in ((values.atPose3, pose), (values.atVector, rate))
        )
        return gp.Ends(T[0].matrix(), v[0], T[1].matrix(), v[1], period)

    def share(J_all: np.ndarray, jacobians) -> None:
        """By [pose, rate] of two knots, in gtsam's order of a pose's tangent."""
        jacobians[0], jacobians[1] = J_all[:, swap], J_all[:, 6:12]
        jacobians[2], jacobians[3] = J_all[:, 12:18][:, swap], J_all[:, 18:]

    def motion(k: int):
        def error(_, values, jacobians):
            gp.motion_error(ends(values, k), e, J, work)
            if jacobians is not None:
                share(J, jacobians)
            return e.copy()

        return error

    def frame(f: int, k: int, tau: float):
        def error(_, values, jacobians):
            gp.relate(ends(values, k), work)
            gp.evaluate(work, tau, True, 0)
            lie_kernels.pose_error(
                measured[f], at['T'], at['gamma'], at['right_gamma'], at['scratch']
            )
            if jacobians is not None:
                share(at['right_gamma'] @ at['J_pose'], jacobians)
            return at['gamma']['x'].copy()

        return error

    def keys(k: int) -> list[int]:
        return [pose(k), rate(k), pose(k + 1), rate(k + 1)]

    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    per_rate = np.array([[12 / period**3, -6 / period**2], [-6 / period**2, 4 / period]])
    model = gtsam.noiseModel.Gaussian.Information(np.kron(per_rate, np.diag(1 / psd)))
    for k in range(KNOTS):
        initial.insert(pose(k), gtsam.Pose3(guess[k]))
        initial.insert(rate(k), np.zeros(6))
        if k < KNOTS - 1:
            graph.add(gtsam.CustomFactor(model, keys(k), motion(k)))
    unit = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    graph.add(gtsam.PriorFactorPose3(pose(0), gtsam.Pose3(guess[0]), unit))
    graph.add(gtsam.PriorFactorVector(rate(0), np.zeros(6), unit))
    for f, time in enumerate(times):
        k = min(int(time / period), KNOTS - 2)
        model = gtsam.noiseModel.Gaussian.Information(information[f])
        graph.add(gtsam.CustomFactor(model, keys(k), frame(f, k, time - k * period)))
    parameters = gtsam.GaussNewtonParams()
    parameters.setMaxIterations(ITERATIONS)
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)

    def solve() -> np.ndarray:
        found = gtsam.GaussNewtonOptimizer(graph, initial, parameters).optimize()
        return np.array([found.atPose3(pose(k)).matrix() for k in range(KNOTS)])

    return solve


if __name__ == '__main__':
    for row in run():
        print(row)
