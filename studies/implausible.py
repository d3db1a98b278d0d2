"""
Sensors that say what their description does not allow: units, axes, conventions, contradictions.

Each case is a simulated recording in which one thing is not as the robot's description has it from
the first sample on. The filter has to name it, with its likely cause, within 3 s of data, to blame
nobody else, and never to say `tracking` while a ring is far off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re
from typing import Any

from continuum_loc.measurements import (
    EncoderSample,
    ImuSample,
    Measurement,
    StrainSample,
    TOF_NO_TARGET,
    TofFrame,
)
from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.simulator.departures import sensor_departures
from continuum_loc.simulator.faults import ClockOffset, Fault
import numpy as np
from studies._filter_runs import Case, CaseResult, failures, longest_unannounced, run_cases
from studies._pages import write_page
from studies.support.split import require_unseen

FRESH = 4000  # first seed: no limit was chosen on a recording of these
TRULY_LATE = 0.02  # s: a sensor whose clock is off by this may be named so
WITHIN = 3.0  # s of data in which the cause has to be named
CLEAN, DISTURBED, WORLD = 'as described', 'disturbed', 'world disturbed'
DISTURBED_RUNS = 5  # of each kind and trajectory
DEGREES = 180.0 / np.pi

Change = Callable[[Any, RobotDescription], Any]


@dataclass(frozen=True, kw_only=True)
class Altered(Fault):
    """Samples changed as a kind says, by its name."""

    kind: str

    def alter(self, sample, rng, memory):
        return BY_NAME[self.kind](sample, ROBOT)


@dataclass(frozen=True)
class Kind:
    """
    One thing that is not as described.

    who: sensors that it strikes and that have to be named, of which `draws` are taken one at a
    time (0: all at once). words: what the reason has to say.
    """

    name: str
    change: Change
    who: tuple[str, ...]
    words: str
    draws: int = 0


def turned(rate_of: Callable[[np.ndarray], np.ndarray], name: str) -> Change:
    """Change of an IMU's angular velocity."""

    def change(sample: Measurement, robot: RobotDescription) -> Measurement:
        if not isinstance(sample, ImuSample):
            return sample
        return replace(sample, angular_velocity=rate_of(sample.angular_velocity))

    change.__name__ = name
    return change


def bent(bending_of: Callable[[np.ndarray, np.ndarray], tuple], name: str) -> Change:
    """Change of the strain sensor's angle and curvature."""

    def change(sample: Measurement, robot: RobotDescription) -> Measurement:
        if not isinstance(sample, StrainSample):
            return sample
        theta, kappa = bending_of(sample.theta, sample.kappa)
        return replace(sample, theta=theta, kappa=kappa)

    change.__name__ = name
    return change


def travelled(travel_of: Callable[[float], float], name: str) -> Change:
    """Change of the insertion encoder's travel."""

    def change(sample: Measurement, robot: RobotDescription) -> Measurement:
        if not isinstance(sample, EncoderSample) or 'insertion' not in sample.names:
            return sample
        position = sample.position.copy()
        at = sample.names.index('insertion')
        position[at] = travel_of(position[at])
        return replace(sample, position=position)

    change.__name__ = name
    return change


def seen(
    ranges_of: Callable[[np.ndarray, np.ndarray, tuple[int, int]], np.ndarray], name: str
) -> Change:
    """Change of a ToF frame's ranges, given its zones' cosines and its grid."""

    def change(sample: Measurement, robot: RobotDescription) -> Measurement:
        if not isinstance(sample, TofFrame):
            return sample
        model = robot.tof_model
        shape = (model.rows, model.columns)
        ranges = ranges_of(sample.ranges, model.directions[:, 0], shape)
        status = ranges_of(sample.status.astype(float), np.ones(len(ranges)), shape)
        finite = np.isfinite(ranges)[:, None]
        points = np.where(finite, ranges[:, None] * model.directions, np.nan)
        if name.endswith('scaled'):
            status = sample.status
        return replace(
            sample, ranges=ranges, points=points, status=np.asarray(status).astype(np.uint8)
        )

    change.__name__ = name
    return change


def blinded(sample: Measurement, robot: RobotDescription) -> Measurement:
    """Let a ToF sensor see no target anywhere."""
    if not isinstance(sample, TofFrame):
        return sample
    return replace(sample, status=np.full(len(sample.status), TOF_NO_TARGET, np.uint8))


def grid(values: np.ndarray, shape: tuple[int, int], axis: int) -> np.ndarray:
    """Turn a frame's rows (axis 0) or columns (axis 1) round."""
    return np.flip(values.reshape(shape), axis).ravel()


ALL = ('*',)
IMUS = ('ring?_imu',)
TOFS = ('ring?_tof?', 'tip_tof')
ENGINE = (
    Kind('gyro in deg/s', turned(lambda w: DEGREES * w, 'degrees'), IMUS, 'degrees', 3),
    Kind('gyro divided by 57', turned(lambda w: w / DEGREES, 'radians'), IMUS, 'radians', 3),
    Kind('all gyros in deg/s', turned(lambda w: DEGREES * w, 'all_degrees'), IMUS, 'degrees'),
    Kind('gyro axes y and z swapped', turned(lambda w: w[[0, 2, 1]], 'swapped'), IMUS, 'axes', 3),
    Kind('gyro axes turned', turned(lambda w: w[[1, 2, 0]], 'turned'), IMUS, 'axes', 2),
    Kind('sign of gyro y', turned(lambda w: w * [1, -1, 1], 'sign_y'), IMUS, 'sign', 2),
    Kind('sign of gyro z', turned(lambda w: w * [1, 1, -1], 'sign_z'), IMUS, 'sign', 2),
    Kind(
        'perpendicular distances taken for ranges',
        seen(lambda r, cosine, shape: r * cosine, 'perpendicular_scaled'),
        TOFS,
        'perpendicular',
    ),
    Kind('ToF rows flipped', seen(lambda r, _, shape: grid(r, shape, 0), 'rows'), TOFS, 'rows'),
    Kind(
        'ToF columns flipped',
        seen(lambda r, _, shape: grid(r, shape, 1), 'columns'),
        TOFS,
        'columns',
    ),
    Kind('rows of one ToF', seen(lambda r, _, shape: grid(r, shape, 0), 'row'), TOFS, 'rows', 2),
    Kind(
        'ToF in millimetres', seen(lambda r, *_: 1e3 * r, 'millimetres_scaled'), TOFS, 'millimet'
    ),
    Kind('no target anywhere', blinded, TOFS, 'no usable zone'),
    Kind('curvature in 1/mm', bent(lambda t, k: (t, 1e-3 * k), 'per_mm'), ('strain',), '1/mm'),
    Kind('curvature in 1/km', bent(lambda t, k: (t, 1e3 * k), 'per_km'), ('strain',), '1000'),
    Kind('angle in degrees', bent(lambda t, k: (DEGREES * t, k), 'angle'), ('strain',), 'degrees'),
    Kind('angle of the other sign', bent(lambda t, k: (-t, k), 'other'), ('strain',), 'sign'),
    Kind('travel in millimetres', travelled(lambda x: 1e3 * x, 'mm'), ('insertion',), 'millimet'),
    Kind('travel beyond its range', travelled(lambda x: x + 1.0, 'far'), ('insertion',), 'range'),
    Kind('travel 5 cm off', travelled(lambda x: x + 0.05, 'off'), ('insertion',), 'contradict'),
)
BY_NAME = {kind.name: kind.change for kind in ENGINE}
ROBOT = load_robot('engine')
QUICK = ('gyro in deg/s', 'perpendicular distances taken for ranges', 'curvature in 1/mm')

TEXT = """
One thing is not as described, from the first sample on. *Named after* is the time of data until
the reason that the filter gives for the sensor says the likely cause; *blamed* are other sensors
that it suspects at any time. *Silent* is the longest time for which a ring was more than 5 cm off
while the status was `tracking`. Disturbed runs with nothing else wrong say how often healthy
sensors are blamed where all departs from the description: mounts 2 mm and 1 deg off, gyros biased
and ToF clocks 10 ms late; and in the world of `simulate --world disturbed`, where the sensors of a
board that is truly 20 ms late, or more, are no healthy ones.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Misdescribe one sensor at a time; `quick`: three ways in one short trial."""
    cases, kinds = implausible_cases(quick, seed)
    require_unseen([case.trial for case in cases])
    results = run_cases(cases, out, jobs)
    rows = [row(result, kinds.get(result.case.folder)) for result in results if result.run]
    claims = judge(rows, len(failures(results)))
    write_study(
        out,
        claims,
        seed=seed,
        settings={'cases': [case.folder for case in cases]},
        tables={'implausible': rows},
        extra={'quick': quick, 'failed': failures(results)},
    )
    write_page(out, 'Implausible sensors', TEXT, claims, {'By case': rows})
    return claims


def implausible_cases(quick: bool, seed: int) -> tuple[list[Case], dict[str, Kind]]:
    """Every kind in every trial, with clean and disturbed runs; kinds by the case's folder."""
    first = FRESH + seed
    trials = [Trial(trajectory=name, seed=first, duration=5.0) for name in ('t2', 't3')]
    trials = trials[:1] if quick else trials
    kinds = [kind for kind in ENGINE if not quick or kind.name in QUICK]
    cases, by_folder = [], {}
    for number, trial in enumerate(trials):
        cases.append(Case(CLEAN, trial))
        if not quick:
            seeds = range(first + 1, first + 1 + DISTURBED_RUNS)
            cases += [Case(DISTURBED, replace(trial, disturbed=True, seed=one)) for one in seeds]
            cases += [Case(WORLD, replace(trial, world='disturbed', seed=one)) for one in seeds]
        for kind in kinds:
            for name, who in chosen(kind, first + number, quick):
                case = Case(f'{kind.name}, {name}', trial, faults=(fault_of(kind, who),))
                cases.append(case)
                by_folder[case.folder] = replace(kind, who=who)
    return cases, by_folder


def chosen(kind: Kind, seed: int, quick: bool) -> list[tuple[str, tuple[str, ...]]]:
    """Whom a kind strikes in each of its cases, with a name for the case."""
    if not kind.draws:
        return [('all', kind.who)]
    robot = load_robot('engine')
    names = [one.name for one in (robot.imu if kind.who == IMUS else robot.tof)]
    drawn = np.random.default_rng([seed, *kind.name.encode()]).permutation(names)
    return [(str(name), (str(name),)) for name in drawn[: 1 if quick else kind.draws]]


def fault_of(kind: Kind, who: tuple[str, ...]) -> Altered:
    """Make the fault of a kind; an encoder's samples come from `joint_states`."""
    sensors = tuple('joint_states' if name == 'insertion' else name for name in who)
    return Altered(sensors=sensors, kind=kind.name)


def row(result: CaseResult, kind: Kind | None) -> dict[str, Any]:
    """Tell what the filter said of a case."""
    culprits = struck(kind) if kind else late(result.case.trial)
    blamed = {name for reasons in result.reasons for name in reasons} - culprits - {'status'}
    after = named_after(result, kind, culprits) if kind else None
    settled = len(result.times) // 4
    return {
        'case': result.case.name,
        'trajectory': result.case.trial.trajectory,
        'named after [s]': after,
        'said': said(result, culprits),
        'blamed': ', '.join(sorted(blamed)) or '-',
        'silent [s]': longest_unannounced(result),
        'worst [cm]': 100.0 * float(result.worst_ring[settled:].max()),
    }


def struck(kind: Kind) -> set[str]:
    """Names of the sensors that a kind strikes."""
    robot = load_robot('engine')
    names = [one.name for one in (*robot.tof, *robot.imu)] + ['strain', 'insertion']
    patterns = [re.compile(who.replace('?', '.')) for who in kind.who]
    return {name for name in names if any(pattern.fullmatch(name) for pattern in patterns)}


def late(trial: Trial) -> set[str]:
    """Names of the sensors whose clocks a trial's world has off."""
    robot, departures = load_robot(trial.robot), trial.departures
    found = sensor_departures(robot, departures, trial.fidelity, trial.seed)
    clocks = [one for one in found if isinstance(one, ClockOffset)]
    return {name for one in clocks if abs(one.offset) >= TRULY_LATE for name in one.sensors}


def named_after(result: CaseResult, kind: Kind, culprits: set[str]) -> float:
    """Time [s] of data until a struck sensor is named with the likely cause; inf if never."""
    for time, reasons in zip(result.steps, result.reasons, strict=True):
        if any(kind.words in reasons.get(name, '') for name in culprits | {'status'}):
            return float(time)
    return float('inf')


def said(result: CaseResult, culprits: set[str]) -> str:
    """Find the last reason that was given for a struck sensor, or the last doubt."""
    for reasons in reversed(result.reasons):
        for name in sorted(culprits & set(reasons)):
            return f'{name}: {reasons[name]}'
    return '-'


def judge(rows: Sequence[dict[str, Any]], failed: int) -> list[Claim]:
    """Causes named in time, nobody else blamed, nothing silent."""
    altered = [one for one in rows if one['named after [s]'] is not None]
    clean = [one for one in rows if one['case'] == CLEAN]
    disturbed = {name: [one for one in rows if one['case'] == name] for name in (DISTURBED, WORLD)}
    claims = [
        at_least(
            'cause named within 3 s',
            np.mean([one['named after [s]'] <= WITHIN for one in altered]),
            'share',
            0.95,
        ),
        at_most(
            'altered runs in which a healthy sensor is blamed',
            np.mean([one['blamed'] != '-' for one in altered]),
            'share',
            0.02,
        ),
        at_most(
            'clean runs in which a sensor is blamed', sum(x['blamed'] != '-' for x in clean), '', 0
        ),
        at_most(
            'longest time off in silence', max(one['silent [s]'] for one in altered), 's', 1.0
        ),
        at_most('cases that failed', failed, '', 0),
    ]
    claims += [
        at_most(
            f'{name}: runs in which a healthy sensor is blamed',
            np.mean([one['blamed'] != '-' for one in members]),
            'share',
            0.02,
        )
        for name, members in disturbed.items()
        if members
    ]
    return claims
