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


class Problem(NamedTuple):
    """Frames and a poor guess (KNOTS, 4, 4) of the knots, `period` [s] apart; noise of motion."""

    times: np.ndarray  # (F,) [s]
    measured: np.ndarray  # (F, 4, 4)
    information: np.ndarray  # (F, 6, 6)
    guess: np.ndarray
    period: float
    psd: np.ndarray  # (6,)


def _temporal_row(repeats: int) -> dict:
    problem = _temporal_problem()
    theirs = _gtsam_chain(problem)

    def ours() -> np.ndarray:
        return _gauss_newton(problem)

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


def _temporal_problem() -> Problem:
    """Make up frames of a body that moves by TWIST."""
    rng = np.random.default_rng(0)
    period = 1.0 / (KNOTS - 1)
    times = np.sort(rng.uniform(0.0, 1.0, FRAMES)).clip(1e-3, 1.0 - 1e-3)
    measured = lie.exp(times[:, None] * TWIST) @ lie.exp(1e-3 * rng.normal(size=(FRAMES, 6)))
    directions = rng.normal(size=(FRAMES, 64, 6))
    information = 1e3 * np.einsum('fzi,fzj->fij', directions, directions)
    knots = np.arange(KNOTS)[:, None] * period
    guess = lie.exp(knots * TWIST) @ lie.exp(SPREAD * rng.normal(size=(KNOTS, 6)))
    psd = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
    return Problem(times, measured, information, guess, period, psd)


def _gauss_newton(problem: Problem) -> np.ndarray:
    """Knot poses (K, 4, 4) after ITERATIONS, by the estimator's kernels and its chain."""
    times, measured, information, guess, period, psd = problem
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


class _GtsamErrors:
    """Errors of motion and frames as gtsam calls them; its Pose3 perturbs [rotation; shift]."""

    SWAP = np.array([3, 4, 5, 0, 1, 2])

    def __init__(self, problem: Problem) -> None:
        from gtsam import symbol_shorthand

        self.problem, self.pose, self.rate = problem, symbol_shorthand.X, symbol_shorthand.V
        self._work, self._e, self._J = gp.new_workspace(), np.empty(12), np.empty((12, 24))

    def keys(self, k: int) -> list[int]:
        """Variables of knots k and k + 1."""
        return [self.pose(k), self.rate(k), self.pose(k + 1), self.rate(k + 1)]

    def _ends(self, values, k: int) -> gp.Ends:
        T = [values.atPose3(self.pose(k + i)).matrix() for i in range(2)]
        v = [values.atVector(self.rate(k + i)) for i in range(2)]
        return gp.Ends(T[0], v[0], T[1], v[1], self.problem.period)

    def _share(self, J: np.ndarray, jacobians) -> None:
        """By [pose, rate] of two knots, in gtsam's order of a pose's tangent."""
        jacobians[0], jacobians[1] = J[:, self.SWAP], J[:, 6:12]
        jacobians[2], jacobians[3] = J[:, 12:18][:, self.SWAP], J[:, 18:]

    def motion(self, k: int) -> Callable:
        """Error of the motion from knot k to the next."""

        def error(_, values, jacobians):
            gp.motion_error(self._ends(values, k), self._e, self._J, self._work)
            if jacobians is not None:
                self._share(self._J, jacobians)
            return self._e.copy()

        return error

    def frame(self, f: int, k: int, tau: float) -> Callable:
        """Error of frame f, tau [s] after knot k."""
        at = self._work[0]

        def error(_, values, jacobians):
            gp.relate(self._ends(values, k), self._work)
            gp.evaluate(self._work, tau, True, 0)
            lie_kernels.pose_error(
                self.problem.measured[f], at['T'], at['gamma'], at['right_gamma'], at['scratch']
            )
            if jacobians is not None:
                self._share(at['right_gamma'] @ at['J_pose'], jacobians)
            return at['gamma']['x'].copy()

        return error


def _gtsam_chain(problem: Problem) -> Callable[[], np.ndarray]:
    """Pose the same problem to gtsam."""
    import gtsam

    errors, d = _GtsamErrors(problem), problem.period
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    per_rate = np.array([[12 / d**3, -6 / d**2], [-6 / d**2, 4 / d]])
    motion = gtsam.noiseModel.Gaussian.Information(np.kron(per_rate, np.diag(1 / problem.psd)))
    for k in range(KNOTS):
        initial.insert(errors.pose(k), gtsam.Pose3(problem.guess[k]))
        initial.insert(errors.rate(k), np.zeros(6))
        if k < KNOTS - 1:
            graph.add(gtsam.CustomFactor(motion, errors.keys(k), errors.motion(k)))
    unit = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    graph.add(gtsam.PriorFactorPose3(errors.pose(0), gtsam.Pose3(problem.guess[0]), unit))
    graph.add(gtsam.PriorFactorVector(errors.rate(0), np.zeros(6), unit))
    for f, time in enumerate(problem.times):
        k = min(int(time / d), KNOTS - 2)
        frame = gtsam.noiseModel.Gaussian.Information(problem.information[f])
        graph.add(gtsam.CustomFactor(frame, errors.keys(k), errors.frame(f, k, time - k * d)))
    return _gtsam_solver(graph, initial, errors.pose)


def _gtsam_solver(graph, initial, pose: Callable[[int], int]) -> Callable[[], np.ndarray]:
    """Make the solve of ITERATIONS that gives the knots' poses (KNOTS, 4, 4)."""
    import gtsam

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
