"""
Which motor is which tendon: its end, sign and angle, from stretches in which it stands out.

Each motor is fitted by itself at every end; the others hang or hold, so that what they do is
bending at rest. The ends are shared out evenly at the least cost first, and settled together
afterwards: one motor after another is tried at the others, over the whole recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from continuum_loc.actuation import Actuation, BodyFriction, Tendon
from continuum_loc.errors import CalibrationError
from continuum_loc.offline.identify import Identification, MARKER_NOISE
from continuum_loc.offline.motor_csv import Recording
from continuum_loc.robot import RobotDescription
import numpy as np
from scipy.optimize import linear_sum_assignment

OUT = 2e-3  # [m]
STILL, MOVING = 5e-5, 1e-4  # [m] from row to row
BROKEN = 0.05
LEAST_TRAVEL = 1e-3  # [m] of a motor alone that tells of its tendon
LEAST_ROWS = 5
STIFF = 10.0  # of a tendon, against the bending of the first stretch seen from it
FRICTION = BodyFriction(share=0.3, bend=1.0)
ALONE_ITERATIONS, TOGETHER_ITERATIONS, TRIAL_ITERATIONS = 12, 15, 3
ROWS = 250  # of a recording, to settle the ends by


def alone(recording: Recording, motor: int) -> np.ndarray:
    """
    Rows (K,) of the longest way that a motor went alone; empty without.

    Alone is a motor that moves while all others hold; failing that, one that moves while it is
    farther out than any other by OUT, as when it is pulled and the others are let out.
    """
    own, others = recording.moved[:, motor], np.delete(recording.moved, motor, axis=1)
    moves = np.abs(np.diff(own)) > MOVING
    held = np.abs(np.diff(others, axis=0)).max(axis=1, initial=0.0) < STILL
    out = (own > others.max(axis=1) + OUT) | (own < others.min(axis=1) - OUT)
    rows = _longest(own, moves & held)
    return rows if len(rows) else _longest(own, moves & out[1:] & out[:-1])


def _longest(own: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Rows (K,) of the longest way of a motor (S,) in a run of `steps` (S - 1,)."""
    best, travel = np.empty(0, int), LEAST_TRAVEL
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steps.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        rows = np.arange(first, last + 1)
        if len(rows) >= LEAST_ROWS and np.ptp(own[rows]) > travel:
            best, travel = rows, float(np.ptp(own[rows]))
    return best


def broken(recording: Recording, motor: int, length: float, arm: float) -> bool:
    """
    Whether the tip stays where it is while a motor goes its way alone.

    Wound up by d over an offset r, a taut tendon turns the tip by d / r, which is then half a
    length off, if it bends all of the body; BROKEN is the share of this below which it does not.
    """
    rows = alone(recording, motor)
    taut = np.ptp(recording.moved[rows, motor]) * length / (2.0 * arm)
    return bool(np.ptp(recording.tip[rows], axis=0).max() < BROKEN * taut)


def find_tendons(
    robot: RobotDescription, recording: Recording, ends: Sequence[float], arm: float, EI: float
) -> RobotDescription:
    """
    Return the description with a block of one tendon per motor of the recording.

    ends: arclengths at which tendons end [m]; arm: their distance from the backbone [m]; EI:
    bending stiffness [N m^2]. Raises CalibrationError for a motor that never moved alone.
    """
    rows = [alone(recording, k) for k in range(len(recording.motors))]
    silent = [name for name, mine in zip(recording.motors, rows, strict=True) if not len(mine)]
    if silent:
        raise CalibrationError(
            f'motors that never moved alone by {1e3 * LEAST_TRAVEL:g} mm: {", ".join(silent)}; '
            'record each of them pulled alone while the others hang'
        )
    found = [
        _candidates(robot, _rows(recording, mine, (k,)), ends, arm, EI)
        for k, mine in enumerate(rows)
        if not broken(recording, k, robot.length, arm)
    ]
    if not found:
        raise CalibrationError('no motor moves the tip: is it the tip of this robot?')
    chosen = _shared_out(np.array([costs for _, costs in found]))
    tendons = tuple(one[end] for (one, _), end in zip(found, chosen, strict=True))
    return settle(_with(robot, tendons, EI, arm), thinned(recording), ends)


def _rows(recording: Recording, rows: np.ndarray, motors: tuple[int, ...] = ()) -> Recording:
    chosen = list(motors) or list(range(len(recording.motors)))
    return replace(
        recording,
        time=recording.time[rows],
        motors=tuple(recording.motors[k] for k in chosen),
        moved=np.ascontiguousarray(recording.moved[np.ix_(rows, chosen)]),
        tip=recording.tip[rows],
        pattern=recording.pattern[rows],
    )


def sign_of(robot: RobotDescription, recording: Recording) -> int:
    """
    Whether a single motor pulls by going up (1) or down (-1).

    A straight body that is bent comes nearer to its base, whichever way it bends.
    """
    moved = recording.moved[:, 0]
    along = (recording.tip - robot.base.T_map_base[:3, 3]) @ robot.base.T_map_base[:3, 0]
    order, few = np.argsort(moved), max(2, len(moved) // 5)
    return 1 if along[order[-few:]].mean() < along[order[:few]].mean() else -1


def _candidates(
    robot: RobotDescription, recording: Recording, ends: Sequence[float], arm: float, EI: float
) -> tuple[list[Tendon], list[float]]:
    """Fit a motor alone at every end: the tendons found, and what each costs."""
    sign = sign_of(robot, recording)
    pulled = sign * recording.moved[:, 0]
    far = recording.tip[np.argmax(pulled)] - recording.tip[np.argsort(pulled)[:3]].mean(axis=0)
    _, y, z = robot.base.T_map_base[:3, :3].T @ far
    tendons, costs = [], []
    for end in ends:
        tendon = Tendon(
            name=recording.motors[0],
            end=end,
            azimuth_deg=float(np.degrees(np.arctan2(z, y))),
            radius=arm,
            sign=sign,
            stiffness=STIFF * EI / (arm**2 * ends[0]),
        )
        search = Identification(_with(robot, (tendon,), EI, arm), recording)
        fit = search.fit(np.ones(len(recording.time), bool), most=ALONE_ITERATIONS)
        tendons.append(fit.robot.actuation.tendons[0])
        costs.append(float(np.sum((fit.error / MARKER_NOISE) ** 2) + fit.z @ fit.z))
    return tendons, costs


def _shared_out(costs: np.ndarray) -> np.ndarray:
    """End (M,) of each motor at the least sum of costs (M, G), as many motors to each end."""
    motors, ends = costs.shape
    seats = np.repeat(np.arange(ends), -(-motors // ends))
    rows, chosen = linear_sum_assignment(costs[:, seats])
    return seats[chosen[np.argsort(rows)]]


def _with(
    robot: RobotDescription, tendons: tuple[Tendon, ...], EI: float, arm: float
) -> RobotDescription:
    block = Actuation(tendons=tendons, EI=(EI,), EA=2.0 * EI / arm**2, friction=FRICTION)
    return robot.model_copy(update={'actuation': block})


def thinned(recording: Recording) -> Recording:
    """Every so many rows of a recording, so that about ROWS are left."""
    return _rows(recording, np.arange(0, len(recording.time), max(1, len(recording.time) // ROWS)))


def settle(
    robot: RobotDescription, recording: Recording, ends: Sequence[float]
) -> RobotDescription:
    """Move one tendon after another to the end that explains the recording best."""
    use = np.ones(len(recording.time), bool)
    best = Identification(robot, recording).fit(use, most=TOGETHER_ITERATIONS)
    changed = True
    while changed:
        changed = False
        for k in range(len(robot.actuation.tendons)):
            for end in ends:
                if end == robot.actuation.tendons[k].end:
                    continue
                trial = _ending(robot, k, end)
                fit = Identification(trial, recording).fit(use, best.z, TRIAL_ITERATIONS)
                if fit.cost < best.cost:
                    robot, best, changed = trial, fit, True
    return robot


def _ending(robot: RobotDescription, tendon: int, end: float) -> RobotDescription:
    """Let one tendon end elsewhere."""
    block = robot.actuation
    tendons = list(block.tendons)
    tendons[tendon] = tendons[tendon].model_copy(update={'end': end})
    block = block.model_copy(update={'tendons': tuple(tendons)})
    return robot.model_copy(update={'actuation': block})
