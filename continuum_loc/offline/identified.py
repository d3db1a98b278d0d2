"""Identification from start to end: tendons, fit, cross-validation, and what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from continuum_loc.errors import BagError, CalibrationError
from continuum_loc.measurements import EncoderSample, NANOSECONDS, TrackedPose, TruthSample
from continuum_loc.offline.find_tendons import alone, broken, find_tendons
from continuum_loc.offline.identify import Fit, Identification, MARKER_NOISE
from continuum_loc.offline.motor_csv import BLOCK, read_csv, Recording
from continuum_loc.robot import Mount, RobotDescription, Sensor
from msg_tools.bag import read_bag
import numpy as np

FOLDS = 6
SLACK = 1e-3  # [m] from which a tendon is said to hang
MARKER = 'marker'
BAG_RATE = 5.0  # [1/s] samples taken of a bag


@dataclass(frozen=True, eq=False)
class Identified:
    """
    What came out.

    robot: the description found. errors: (S, 3) of the tip [m] in the fit, held_out: each pattern
    predicted by a fit without it. nees: (S,) of the latter per degree of freedom, each half of the
    folds with the spread found on the other. findings: what is wrong with a tendon, in words.
    """

    robot: RobotDescription
    recording: Recording
    errors: np.ndarray
    held_out: np.ndarray
    nees: np.ndarray
    findings: tuple[str, ...]

    def figures(self) -> dict[str, float]:
        return {
            'tip RMSE, fit [mm]': rmse(self.errors),
            'tip RMSE, patterns held out [mm]': rmse(self.held_out),
            'NEES/dof, patterns held out': float(self.nees.mean()),
        }


def rmse(errors: np.ndarray) -> float:
    """Root mean square [mm] of errors (S, 3) [m] without their mean."""
    return 1e3 * float(np.sqrt(np.mean(np.sum((errors - errors.mean(axis=0)) ** 2, axis=1))))


def identify(
    robot: RobotDescription,
    recording: Recording,
    arm: float | None = None,
    tell: Callable[[str], None] = lambda said: None,
) -> Identified:
    """
    Identify the block `actuation`; one that the description has already is where it starts.

    arm: distance of tendons from the backbone [m], where there is none.
    """
    if robot.actuation is None:
        if arm is None:
            raise CalibrationError(
                f"robot '{robot.name}' has no block `actuation`: say how far tendons run from the "
                'backbone (`--arm`, metres), and where modules end (`backbone.module_ends`)'
            )
        tell('which motor is which tendon')
        ends = [*robot.backbone.module_ends, robot.length]
        robot = find_tendons(robot, recording, ends, arm, EI=1.0)
    search = Identification(robot, recording)
    tell('fitting all unknowns')
    fit = search.fit(np.ones(len(recording.time), bool))
    held_out, tips, fold = _cross_validate(search, tell)
    nees, spread = _honest(fit, held_out, tips, fold)
    found = _with_marker(_with_spread(fit.robot, spread), search.named(fit.z)['marker'])
    return Identified(found, recording, fit.error, held_out, nees, _findings(found, recording))


def folds_of(pattern: np.ndarray) -> np.ndarray:
    """Fold (S,) of each sample; all of a pattern are in one."""
    names = list(dict.fromkeys(pattern.tolist()))
    return np.array([names.index(name) % FOLDS for name in pattern])


def _cross_validate(
    search: Identification, tell: Callable[[str], None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (S, 3) with each fold left out, covariance (S, 3, 3) of that fit, folds (S,)."""
    fold = folds_of(search.recording.pattern)
    errors, covariance = np.zeros_like(search.recording.tip), np.zeros((len(fold), 3, 3))
    for number in range(fold.max() + 1):
        tell(f'cross-validation, {number + 1} of {fold.max() + 1}')
        out = fold == number
        fit = search.fit(~out)
        J = fit.history.slope[out]
        errors[out] = fit.error[out]
        covariance[out] = J @ fit.covariance @ J.transpose(0, 2, 1)
    return errors, covariance, fold


def _honest(
    fit: Fit, errors: np.ndarray, covariance: np.ndarray, fold: np.ndarray
) -> tuple[np.ndarray, float]:
    """NEES per degree of freedom (S,), and the bending's spread [1/m] of all."""
    J = fit.history.by_strain.reshape(len(errors), 3, -1, 4)[..., 2:]
    by_bend = np.einsum('sinc,sjnc->sij', J, J)
    nees = np.zeros(len(errors))
    for half in (0, 1):
        mine = fold % 2 == half
        spread = _spread(errors[~mine], covariance[~mine], by_bend[~mine])
        nees[mine] = _nees(errors[mine], covariance[mine], by_bend[mine], spread)
    return nees, _spread(errors, covariance, by_bend)


def _nees(
    errors: np.ndarray, covariance: np.ndarray, by_bend: np.ndarray, spread: float
) -> np.ndarray:
    S = covariance + spread**2 * by_bend + MARKER_NOISE**2 * np.eye(3)
    return np.einsum('si,si->s', errors, np.linalg.solve(S, errors[..., None])[..., 0]) / 3.0


def _spread(errors: np.ndarray, covariance: np.ndarray, by_bend: np.ndarray) -> float:
    """Spread of the bending [1/m] at which NEES per degree of freedom is 1."""
    low, high = 1e-4, 1e2
    for _ in range(60):
        middle = np.sqrt(low * high)
        if _nees(errors, covariance, by_bend, middle).mean() > 1.0:
            low = middle
        else:
            high = middle
    return float(np.sqrt(low * high))


def _with_spread(robot: RobotDescription, spread: float) -> RobotDescription:
    block = robot.actuation
    sigma = (block.strain_sigma[0], spread, spread)
    return robot.model_copy(update={'actuation': block.model_copy(update={'strain_sigma': sigma})})


def _with_marker(robot: RobotDescription, marker: np.ndarray) -> RobotDescription:
    """Put the marker found on the last ring, as its tracker."""
    mount = Mount(xyz=tuple(marker.tolist()), rpy_deg=(0.0, 0.0, 0.0))
    last = robot.rings[-1].name
    others = [one for one in robot.trackers if one.ring != last]
    name = next((one.name for one in robot.trackers if one.ring == last), MARKER)
    return robot.model_copy(
        update={'trackers': (*others, Sensor(name=name, ring=last, mount=mount))}
    )


def _findings(robot: RobotDescription, recording: Recording) -> tuple[str, ...]:
    tendons = robot.actuation.tendons
    usual = 1 if sum(tendon.sign for tendon in tendons) >= 0 else -1
    arm = float(np.median([tendon.radius for tendon in tendons]))
    found = [
        f"motor '{name}' goes {1e3 * np.ptp(recording.moved[rows, k]):.1f} mm alone and does not "
        'move the tip: broken tendon, or not coupled'
        for k, name in enumerate(recording.motors)
        if len(rows := alone(recording, k)) and broken(recording, k, robot.length, arm)
    ]
    for tendon in tendons:
        if tendon.sign != usual:
            way = 'down' if tendon.sign < 0 else 'up'
            found.append(
                f"motor '{tendon.name}' pulls by going {way}, the others do not: reversed"
            )
        if tendon.offset < -SLACK:
            found.append(
                f"tendon of '{tendon.name}' hangs by {-1e3 * tendon.offset:.1f} mm at position 0: "
                'slack'
            )
    return tuple(found)


def predict(robot: RobotDescription, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Errors (S, 3) of the tip [m] of a description on a recording, and NEES/dof (S,)."""
    from continuum_loc.mechanics.history import follow

    tracker = next((one for one in robot.trackers if one.ring == robot.rings[-1].name), None)
    marker = np.zeros(3) if tracker is None else tracker.mount.T_ring_sensor[:3, 3]
    search = Identification(robot, recording)
    model = search.model(np.zeros(len(search.sigma)))._replace(tip=marker)
    history = follow(model)
    errors = history.tip - recording.tip
    J = history.by_strain.reshape(len(errors), 3, -1, 4)[..., 2:]
    by_bend = np.einsum('sinc,sjnc->sij', J, J)
    spread = robot.actuation.strain_sigma[1]
    return errors, _nees(errors, np.zeros((len(errors), 3, 3)), by_bend, spread)


def read_recording(path: Path, robot: RobotDescription) -> Recording:
    """Read a CSV table or a bag of motors and of a tracked or true tip."""
    return read_csv(path) if path.suffix.lower() == '.csv' else read_bag_recording(path, robot)


def read_bag_recording(path: Path, robot: RobotDescription) -> Recording:
    """
    Read motors (`joint_states`) and the tip, by a tracker on the last ring or else by the truth.

    Motors are taken at the instants of the tip, BAG_RATE times a second.
    """
    last = robot.rings[-1].name
    trackers = {one.name: one.mount.T_ring_sensor for one in robot.trackers if one.ring == last}
    motors, tracked, true = [], [], []
    for _, sample in read_bag(path):
        if isinstance(sample, EncoderSample):
            motors.append(sample)
        elif isinstance(sample, TrackedPose) and sample.sensor in trackers:
            tracked.append((sample.stamp, sample.T_map_sensor[:3, 3]))
        elif isinstance(sample, TruthSample):
            true.append((sample.stamp, sample.T_map_ring[-1, :3, 3]))
    tip = tracked or true
    if not motors or not tip:
        raise BagError(
            f'{path}: needs `joint_states`, and `tracker/<sensor>` of a tracker on ring '
            f"'{last}' or `ground_truth/poses`"
        )
    return _sampled(motors, tip)


def _sampled(motors: Sequence[EncoderSample], tip: Sequence[tuple[int, Any]]) -> Recording:
    names = tuple(name for name in motors[0].names if name != 'insertion')
    column = [motors[0].names.index(name) for name in names]
    stamps = np.array([one.stamp for one in motors])
    moved = np.array([one.position[column] for one in motors])
    if not np.isfinite(moved).all():
        moved = np.array([one.effort[column] for one in motors])
    at, keep, after = np.array([stamp for stamp, _ in tip]), [], -1
    for i, stamp in enumerate(at):
        if stamp >= after and stamps[0] <= stamp <= stamps[-1]:
            keep.append(i)
            after = stamp + int(NANOSECONDS / BAG_RATE)
    time = (at[keep] - stamps[0]) / NANOSECONDS
    moved = np.stack(
        [np.interp(at[keep] - stamps[0], stamps - stamps[0], one) for one in moved.T], axis=1
    )
    places = np.array([tip[i][1] for i in keep])
    pattern = np.array([f'block{int(t // BLOCK)}' for t in time])
    return Recording(time, names, moved, places, pattern)
