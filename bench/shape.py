"""
Shape from Hall sensors and IMUs.

A whole estimate, and three positions beside SciPy's bounded minimisers.

`run(quick)` gives a list of rows:
- *shape, whole estimate*: what one estimate of the online estimator costs, the samples of three
  IMUs and three Hall sensors since the last one included (attitude, three positions with
  covariances, the curve);
- *shape, three positions*: eq. 10 for three modules, from the same start within the same bounds,
  with the same exact gradients, to solutions that agree to a micrometre (`agreement_m`, the
  largest distance between them).

SciPy's `trust-constr` is its interior-point minimiser, as MATLAB's `fmincon` is in the paper;
`least_squares` is what one would rather use. Both solve for millimetres and relative fields, in
which they behave best, and `trust-constr` to its own default tolerances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import process_time

from bench.harness import alone, one_core, side_by_side
from continuum_loc.magnet import field_and_gradient
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.shape import ShapeEstimator, ShapeSettings
from continuum_loc.shape.position import PositionSolver
from continuum_loc.simulator.hall_arm import Arm, bent, groove_motion, out_of_plane
import numpy as np
from scipy.optimize import Bounds, least_squares, minimize

BOUNDS = [
    ('shape, whole estimate', 'ours_s', 'at most', 0.5e-3),
    ('shape, three positions', 'ours_s', 'at most', 0.3e-3),
    ('three positions, trust-constr', 'ratio', 'at least', 50.0),
    ('shape, three positions', 'agreement_m', 'at most', 1e-6),
]
MM = 1e-3
Solve = Callable[[np.ndarray, np.ndarray], np.ndarray]


def run(quick: bool = False) -> list[dict]:
    """
    Rows of name, ours_s, peer, peer_s, ratio (peer / ours), spread and agreement_m.

    Times are in seconds; the spread is the ratio's quartiles.
    """
    robot = load_robot('hall_arm')
    solver = PositionSolver(
        robot.magnet, np.array([robot.sensor_arclength(sensor.name) for sensor in robot.hall])
    )
    problems = list(_problems(robot, 4 if quick else 12))
    with one_core():
        rows = [_whole_estimate(robot, 2 if quick else 6)]
        rows += [
            _compare(
                solver, f'shape, three positions, {name}', name, peer, problems, 3 if quick else 9
            )
            for name, peer in (
                ('trust-constr', _trust_constr(solver)),
                ('least_squares', _least_squares(solver)),
            )
        ]
    return rows


def _whole_estimate(robot: RobotDescription, repeats: int) -> dict:
    """
    Median over the estimates at the IMU's own rate.

    On the way from straight into a groove and resting there.
    """
    arm = Arm(robot, seed=0)
    samples = arm.record(groove_motion(arm, bent(robot, 12.5)))
    times = []
    for _ in range(repeats + 1):
        estimator, spent, costs = (
            ShapeEstimator(robot, ShapeSettings(rate=robot.imu_model.rate)),
            0.0,
            [],
        )
        for sample in samples:
            begin = process_time()
            estimate = estimator.process(sample)
            spent += process_time() - begin
            if estimate is not None:
                costs.append(spent)
                spent = 0.0
        times.append(float(np.median(costs)))
    return alone('shape, whole estimate', np.median(times[1:]))


def _problems(robot: RobotDescription, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Fields (3, 3) [T] of noisy modules in the magnet's frame, and starts (3, 3) [m].

    The starts are some millimetres off.
    """
    rng = np.random.default_rng(0)
    arm = Arm(robot, seed=0)
    for k in range(count):
        curvature, turn = rng.uniform(1.0, 25.0), rng.uniform(-np.pi, np.pi)
        strain = bent(robot, curvature, turn) if k % 2 else out_of_plane(robot, curvature, turn)
        p = arm.T_base_module(strain)[:, :3, 3]
        noise = robot.hall_model.sigma * rng.standard_normal((3, 3))
        yield (
            field_and_gradient(robot.magnet, p)[0] + noise,
            p + 2e-3 * rng.standard_normal((3, 3)),
        )


def _trust_constr(solver: PositionSolver) -> Solve:
    def solve(field: np.ndarray, start: np.ndarray) -> np.ndarray:
        found = np.empty((3, 3))
        for m in range(3):
            size = np.linalg.norm(field[m])

            def cost(q: np.ndarray, m: int = m, size: float = size) -> tuple[float, np.ndarray]:
                b, gradient = field_and_gradient(solver.magnet, q * MM)
                error = (b - field[m]) / size
                return error @ error, 2.0 * MM / size * (gradient.T @ error)

            low, high = solver.lower[m], solver.upper[m]
            found[m] = (
                minimize(
                    cost,
                    np.clip(start[m], low, high) / MM,
                    jac=True,
                    method='trust-constr',
                    bounds=Bounds(low / MM, high / MM),
                ).x
                * MM
            )
        return found

    return solve


def _least_squares(solver: PositionSolver) -> Solve:
    def solve(field: np.ndarray, start: np.ndarray) -> np.ndarray:
        found = np.empty((3, 3))
        for m in range(3):
            size, low, high = np.linalg.norm(field[m]), solver.lower[m], solver.upper[m]
            inside = np.clip(start[m], low + 1e-6, high - 1e-6)
            found[m] = (
                least_squares(
                    lambda q, m=m, size=size: (
                        (field_and_gradient(solver.magnet, q * MM)[0] - field[m]) / size
                    ),
                    inside / MM,
                    jac=lambda q, size=size: (
                        field_and_gradient(solver.magnet, q * MM)[1] * MM / size
                    ),
                    bounds=(low / MM, high / MM),
                    xtol=1e-10,
                    ftol=1e-12,
                    gtol=1e-12,
                ).x
                * MM
            )
        return found

    return solve


def _compare(
    solver: PositionSolver,
    name: str,
    peer: str,
    theirs: Solve,
    problems: list[tuple[np.ndarray, np.ndarray]],
    repeats: int,
) -> dict:
    """Ours and the peer's over all problems, and how far apart their answers are."""
    gaps = [
        np.linalg.norm(solver.solve(*problem).position - theirs(*problem), axis=1).max()
        for problem in problems
    ]
    return side_by_side(
        name,
        lambda: [solver.solve(*problem) for problem in problems],
        f'SciPy {peer}',
        lambda: [theirs(*problem) for problem in problems],
        repeats,
        per_call=len(problems),
        agreement_m=float(max(gaps)),
    )


if __name__ == '__main__':
    for row in run():
        print(row)
