"""
Calibration of a robot from its recordings: all motion and all constants in one least squares.

Columns of all recordings and the constants of `parameters` are solved together by Gauss-Newton:
each recording's columns are eliminated (`Recording.eliminate`), what they leave is added up with
what the description's tolerances say, and the step of the constants moves every column along.
Directions that nothing in the recordings shows stay where the description has them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from continuum_loc.calibration.recording import Recording
from continuum_loc.errors import CalibrationError
from continuum_loc.estimator.parameters import Block, Parameters, PARTS
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import Measurement, TrackedPose, TruthSample
from continuum_loc.robot import mounted, RobotDescription, Sensor
import numpy as np
from threadpoolctl import threadpool_limits

MOST_ITERATIONS = 12
SMALL = 0.1  # of its standard deviation, by which no constant moves any more
TRUTH_SIGMA = (0.0003, 0.05)  # m, deg: truth is not known better than this between two samples
TRUTH_PERIOD = 50_000_000  # ns: more often than that it says nothing new
TOLD = 0.5  # share of its variance beforehand that has to go for a constant to count as found


@dataclass(frozen=True, eq=False)
class Calibration:
    """
    What the recordings say of a robot.

    robot: as it turned out; parameters: of the robot as it was described; theta, sigma: (P,) what
    it departs from that by, and how well that is known; covariance: (P, P); cost: at each
    iteration; converged: whether the last moved nothing any more.
    """

    robot: RobotDescription
    parameters: Parameters
    theta: np.ndarray
    covariance: np.ndarray
    cost: tuple[float, ...]
    converged: bool

    @property
    def sigma(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def told(self, block: Block) -> np.ndarray:
        """Share (n,) of each constant's variance that the recordings took away."""
        return 1.0 - np.square(self.sigma[block.at] / block.sigma)

    def unseen(self) -> list[str]:
        """Name the constants that the recordings do not show."""
        return [
            f'{block.name} {block.kind} {part}'.strip()
            for block in self.parameters.blocks
            for part, share in zip(PARTS[block.kind], self.told(block), strict=True)
            if share < TOLD
        ]


def calibrate(
    robot: RobotDescription,
    prior_map: PriorMap | None,
    recordings: Sequence[Sequence[Measurement | TruthSample]],
    settings: EstimatorSettings,
    reference: str = 'none',
    progress: Callable[[str, float], None] = lambda doing, done: None,
) -> Calibration:
    """
    Find the constants of a robot that its recordings show.

    reference: `none` (map and sensors alone), `tracker` (the robot's trackers too), or `truth`
    (the recordings' truth of every ring). progress: told what is done, and the share or the time
    of it. Raises CalibrationError where there is nothing to find, or to find it by.
    """
    watched, streams, exact = _referred(robot, recordings, reference)
    middle = None if prior_map is None else prior_map.points.mean(axis=0)
    parameters = Parameters(watched, middle=middle, exact=exact)
    if parameters.size == 0:
        raise CalibrationError(
            f"the tolerances of robot '{robot.name}' say that all of it is exactly as described"
        )
    batch = [Recording(stream) for stream in streams]
    with threadpool_limits(limits=1, user_api='blas'):
        for number, recording in enumerate(batch, 1):
            label = f'recording {number} of {len(batch)}'
            recording.start(watched, prior_map, settings, partial(progress, label))
        found = _solve(parameters, prior_map, batch, settings, progress)
    if exact:
        own = found.robot.model_copy(update={'trackers': robot.trackers})
        found = replace(found, robot=own)
    return found


def _solve(parameters, prior_map, batch, settings, progress) -> Calibration:
    """Iterate until no constant moves any more."""
    theta, prior = np.zeros(parameters.size), parameters.sigma**-2.0
    here, costs, converged = parameters, [], False
    while not converged and len(costs) < MOST_ITERATIONS:
        progress('solving', len(costs) / MOST_ITERATIONS)
        moved = here.T_map_moved(theta)
        map_ = prior_map if np.array_equal(moved, np.eye(4)) else prior_map.moved(moved)
        cost = sum(one.read(here.robot, map_, settings) for one in batch)
        parts = [one.eliminate(here) for one in batch]
        H = np.diag(prior) + sum(part[0] for part in parts)
        g = prior * theta + sum(part[1] for part in parts)
        covariance = np.linalg.inv(H)
        step = parameters.centred(theta, -covariance @ g)
        for one in batch:
            one.move(step)
        costs.append(cost + 0.5 * float(prior @ np.square(theta)))
        converged = bool(np.all(np.abs(step) < SMALL * np.sqrt(np.diag(covariance))))
        theta, here = theta + step, here.at(step)
    return Calibration(here.robot, parameters, theta, covariance, tuple(costs), converged)


def _referred(robot, recordings, reference):
    """Return the robot with what it is compared with, its streams, and names that are exact."""
    if reference == 'truth':
        names = {ring: f'truth of {ring}'.replace(' ', '_') for ring in robot.ring_names}
        here = mounted(np.eye(4))
        rings = tuple(Sensor(name=name, ring=ring, mount=here) for ring, name in names.items())
        streams = [list(_with_truth(stream, list(names.values()))) for stream in recordings]
        if not all(any(isinstance(one, TrackedPose) for one in stream) for stream in streams):
            raise CalibrationError('reference truth: a recording has no truth')
        return robot.model_copy(update={'trackers': rings}), streams, set(names.values())
    streams = [
        [one for one in stream if not isinstance(one, TruthSample)] for stream in recordings
    ]
    if reference == 'tracker':
        if not robot.trackers:
            raise CalibrationError(f"reference tracker: robot '{robot.name}' has no tracker")
        return robot, streams, set()
    if reference != 'none':
        raise CalibrationError(f"no reference '{reference}'; valid are none, tracker and truth")
    return robot, [_without(TrackedPose, stream) for stream in streams], set()


def _without(kind, stream):
    return [one for one in stream if not isinstance(one, kind)]


def _with_truth(stream, names):
    """Yield measurements, and the truth of the rings as if trackers had told it."""
    sigma = np.repeat([TRUTH_SIGMA[0], np.radians(TRUTH_SIGMA[1])], 3)
    last = -TRUTH_PERIOD
    for one in stream:
        if isinstance(one, TruthSample) and one.stamp - last >= TRUTH_PERIOD:
            last = one.stamp
            for name, T_map_ring in zip(names, one.T_map_ring[1:], strict=True):
                yield TrackedPose(one.stamp, name, T_map_ring, np.diag(np.square(sigma)))
        elif not isinstance(one, (TrackedPose, TruthSample)):
            yield one
