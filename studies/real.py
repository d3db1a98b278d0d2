"""
Recorded trials of a real tendon-driven robot.

Beside the published C++ sliding-window filter and Hermite curves.

The trials are found through the environment variable CONTINUUM_LOC_DATA: a folder that holds
`slow_free_space` and `impulse_2`. Motion capture is the truth and never an input. Errors are taken
at every stamp of motion capture in the windows that the published figures are for: the estimate
there lies on the Gaussian process between the two estimates around it; Hermite curves lie between
the two tracked poses, interpolated to that stamp. Tracked poses that the logger only held are
dropped and the stamps of the others evened out; the published figures, Hermite's among them, are
of the poses as logged.

The filter's numbers are the same for both trials and were chosen on the rest of them (`TUNED_ON`),
but not blindly: errors inside the windows were seen while choosing, and the backbone's effective
length was calibrated against motion capture of the same trials, which the C++ filter did not have.
Read the comparison with that in mind.
"""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
from time import perf_counter

from continuum_loc import lie
from continuum_loc.errors import StudyError
from continuum_loc.estimate import Estimate
from continuum_loc.estimator import gp, load_estimator_settings, SlidingWindowFilter
from continuum_loc.measurements import nanoseconds, seconds, TrackedPose
from continuum_loc.offline.claims import at_most, Claim, write_study
from continuum_loc.offline.metrics import COVERAGE_BOUND, DOF, nees
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.trajectory import known_at
import numpy as np
from studies.support.tendon_robot import read_recording, Recording, STAMP_OF_ZERO

DATA = 'CONTINUUM_LOC_DATA'
ROBOT = 'tendon_robot'
WINDOWS = {'slow_free_space': (19.0, 29.0), 'impulse_2': (8.0, 18.0)}  # [s]
TUNED_ON = {
    'slow_free_space': 'before 19 s and after 29 s',
    'impulse_2': 'before 8 s and after 18 s',
}
DISCS = ('disc1', 'disc2', 'disc3', 'disc4')
# Translation RMSE [mm] of the C++ code at DISCS, and of cubic Hermite curves from base to tip.
PUBLISHED = {
    ('slow_free_space', 'newest'): (7.4, 13.5, 11.9, 5.4),
    ('slow_free_space', 'lag 0.1 s'): (7.3, 13.3, 11.7, 5.4),
    ('impulse_2', 'newest'): (11.9, 11.6, 13.6, 9.8),
    ('impulse_2', 'lag 0.1 s'): (11.8, 12.1, 12.3, 6.7),
}
HERMITE = {'slow_free_space': (11.1, 22.8, 20.9, 5.5), 'impulse_2': (10.9, 11.8, 12.4, 8.5)}
STEP_MS = 5.0


@dataclass(frozen=True, eq=False)
class DiscErrors:
    """
    Errors of one disc at K stamps.

    Translation (K,) [m], rotation (K,) [deg], nees (K,) of 6 degrees of freedom.
    """

    translation: np.ndarray
    rotation: np.ndarray
    nees: np.ndarray


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Both trials whole, all at one tuning.

    `quick`: impulse_2 alone, from 5 s to the window's end.
    """
    folder, robot, settings = data_folder(), load_robot(ROBOT), load_estimator_settings(ROBOT)
    claims, rows, times = [], [], []
    for trial in ('impulse_2',) if quick else WINDOWS:
        recording = read_recording(folder / trial, robot)
        span = (5.0, WINDOWS[trial][1] + 0.5) if quick else (-np.inf, np.inf)
        newest, lagged, step_ms = estimates(
            recording, SlidingWindowFilter(robot, None, settings), span
        )
        times += step_ms
        hermite = hermite_errors(recording, robot, WINDOWS[trial])
        for kind, made in (('newest', newest), ('lag 0.1 s', lagged)):
            found = disc_errors(made, recording, robot, WINDOWS[trial])
            rows += [_row(trial, kind, disc, found[disc], hermite[disc]) for disc in DISCS]
    claims = judge(rows) + [at_most('median step', float(np.median(times)), 'ms', STEP_MS)]
    write_study(
        out,
        claims,
        seed=seed,
        settings={'robot': robot, 'estimator': settings},
        tables={'real': rows},
        extra={
            'quick': quick,
            'windows': WINDOWS,
            'tuned_on': TUNED_ON,
            'blind': False,
            'step_ms': {'median': np.median(times), 'p95': np.percentile(times, 95)},
        },
    )
    return claims


def data_folder() -> Path:
    """Find the folder of the trials. Raises StudyError, which says how to name it."""
    named = os.environ.get(DATA)
    if not named:
        raise StudyError(
            'the recorded trials are not part of the package: '
            f'set {DATA} to the folder that holds {" and ".join(WINDOWS)}'
        )
    for folder in (Path(named), Path(named) / ROBOT):
        if all((folder / trial).is_dir() for trial in WINDOWS):
            return folder
    raise StudyError(
        f'{DATA} is {named}, which does not hold {" and ".join(WINDOWS)}, '
        f'nor does {Path(named) / ROBOT}'
    )


def estimates(
    recording: Recording,
    estimator: SlidingWindowFilter,
    span: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[list[Estimate], list[Estimate], list[float]]:
    """
    Newest and lagged estimates, and the time of each step [ms].

    span: what part of the measurements is used, in seconds of the trial.
    """
    newest, lagged, step_ms = [], [], []
    for sample in recording.measurements:
        if not span[0] <= (sample.stamp - STAMP_OF_ZERO) * 1e-9 <= span[1]:
            continue
        started = perf_counter()
        estimate = estimator.process(sample)
        if estimate is not None:
            step_ms.append(1e3 * (perf_counter() - started))
            newest.append(estimate)
            lagged += [estimate.lagged] if estimate.lagged is not None else []
    return newest, lagged, step_ms


def disc_errors(
    made: list[Estimate],
    recording: Recording,
    robot: RobotDescription,
    window: tuple[float, float],
) -> dict[str, DiscErrors]:
    """
    Errors by disc at the stamps of motion capture in `window` [s].

    The covariance at a stamp is that of the estimate that follows it.
    """
    ordered = sorted(
        {estimate.stamp: estimate for estimate in made}.values(),
        key=lambda estimate: estimate.stamp,
    )
    stamps = np.array([estimate.stamp for estimate in ordered])
    found = {}
    for disc in DISCS:
        ring = 1 + robot.ring_names.index(disc)
        at, T_map_true = _in_window(recording, disc, window)
        after = np.searchsorted(stamps, at)
        T_map_disc = np.stack(
            [
                _between(ordered[k - 1], ordered[k], ring, stamp)
                for k, stamp in zip(after, at, strict=True)
            ]
        )
        error = lie.log(lie.inverse(T_map_disc) @ T_map_true)
        found[disc] = DiscErrors(
            np.linalg.norm(T_map_disc[:, :3, 3] - T_map_true[:, :3, 3], axis=1),
            np.degrees(np.linalg.norm(error[:, 3:], axis=1)),
            nees(error, np.stack([ordered[k].covariance[ring] for k in after])),
        )
    return found


def _in_window(
    recording: Recording, disc: str, window: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    stamps, T_map_true = recording.truth[disc]
    first, last = (STAMP_OF_ZERO + nanoseconds(time) for time in window)
    inside = (stamps >= first) & (stamps <= last)
    return stamps[inside], T_map_true[inside]


def _between(a: Estimate, b: Estimate, ring: int, stamp: int) -> np.ndarray:
    ends = gp.Ends(
        a.T_map_ring[ring],
        a.velocity[ring],
        b.T_map_ring[ring],
        b.velocity[ring],
        seconds(b.stamp, a.stamp),
    )
    return gp.interpolate(ends, seconds(stamp, a.stamp)).T


def hermite_errors(
    recording: Recording, robot: RobotDescription, window: tuple[float, float]
) -> dict[str, np.ndarray]:
    """
    Compute translation errors (K,) [m] by disc of the cubic curve from base to tip.

    Its end tangents are as long as the backbone: the peer that needs no filter.
    """
    base, tip = (_tracked(recording, tracker.name) for tracker in robot.trackers)
    found = {}
    for disc in DISCS:
        at, T_map_true = _in_window(recording, disc, window)
        T_a, T_b = _interpolated(base, at), _interpolated(tip, at)
        u = robot.ring_arclengths[robot.ring_names.index(disc)] / robot.length
        curve = (
            (1 + 2 * u) * (1 - u) ** 2 * T_a[:, :3, 3]
            + u**2 * (3 - 2 * u) * T_b[:, :3, 3]
            + robot.length * u * (1 - u) * ((1 - u) * T_a[:, :3, 0] - u * T_b[:, :3, 0])
        )
        found[disc] = np.linalg.norm(curve - T_map_true[:, :3, 3], axis=1)
    return found


def _tracked(recording: Recording, sensor: str) -> tuple[np.ndarray, np.ndarray]:
    poses = [
        sample
        for sample in recording.measurements
        if isinstance(sample, TrackedPose) and sample.sensor == sensor
    ]
    return np.array([pose.stamp for pose in poses]), np.stack(
        [pose.T_map_sensor for pose in poses]
    )


def _interpolated(tracked: tuple[np.ndarray, np.ndarray], at: np.ndarray) -> np.ndarray:
    stamps, T = tracked
    if not known_at(stamps, at, longest_gap=0.2).all():
        raise StudyError('the trackers were silent for more than 0.2 s in the window')
    after = np.clip(np.searchsorted(stamps, at, side='right'), 1, len(stamps) - 1)
    return lie.interpolate(
        T[after - 1], T[after], (at - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
    )


def _row(trial: str, kind: str, disc: str, found: DiscErrors, hermite: np.ndarray) -> dict:
    """
    One line of the table.

    Ours, the C++ code's and Hermite's RMSE [mm], and how honest our covariance is.
    """
    return {
        'trial': trial,
        'state': kind,
        'disc': disc,
        'RMSE mm': 1e3 * _rms(found.translation),
        'C++ mm': PUBLISHED[trial, kind][DISCS.index(disc)],
        'Hermite mm': HERMITE[trial][DISCS.index(disc)],
        'Hermite, evened stamps mm': 1e3 * _rms(hermite),
        'RMSE deg': _rms(found.rotation),
        'NEES/dof': float(np.mean(found.nees)) / DOF,
        'in 95 %, %': 100.0 * float(np.mean(found.nees <= COVERAGE_BOUND)),
        'stamps': len(found.translation),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def judge(rows: list[dict]) -> list[Claim]:
    """Claim that no disc's RMSE exceeds the C++ code's, nor that of a Hermite curve."""
    claims = []
    for row in rows:
        name = f'{row["trial"]}, {row["disc"]}, {row["state"]}'
        claims += [
            at_most(f'{name}: RMSE against the C++ code', row['RMSE mm'], 'mm', row['C++ mm']),
            at_most(f'{name}: RMSE against Hermite', row['RMSE mm'], 'mm', row['Hermite mm']),
        ]
    return claims
