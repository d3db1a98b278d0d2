"""
Whether the filter's covariances are honest.

NEES and coverage, by ring, by component and by how fast it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from continuum_loc.measurements import NANOSECONDS
from continuum_loc.offline.claims import at_most, between, Claim, write_study
from continuum_loc.offline.error_tables import trial_rows
from continuum_loc.offline.metrics import COVERAGE_BOUND, DOF, Errors, errors
from continuum_loc.offline.runs import load_run, settled
from continuum_loc.offline.trials import Trial
from continuum_loc.trajectory import Trajectory
import numpy as np
from studies._pages import write_page
from studies.support.campaign import run_campaign
from studies.support.split import HOLD_OUT, require_unseen
from studies.support.worlds import column, in_worlds, told

NEES = (0.7, 1.5)
COVERAGE = (0.90, 0.98)
DRAWS = 10  # seeds of each robot, over which its paths go round
PATHS = (
    (('engine', 'S0', 't2', 'S0'), ('engine', 'S0', 't3', 'S0'), ('engine', 'S9', 't2', 'S0')),
    (('soft_arm', 'R1', 'b2', 'R1'), ('soft_arm', 'R1', 'b3', 'R1')),
)
COMPONENTS = ('x', 'y', 'z', 'about x', 'about y', 'about z')
SPEEDS = (0.0, 0.05, 0.2, np.inf)  # rad/s
SPAN = 50_000_000  # ns over which a ring's true speed is taken

TEXT = """
The pose error of a ring is xi = Log(T_est^-1 T_true), with the covariance P that the filter states
for it. An honest filter has a NEES of xi^T P^-1 xi / 6 near 1, and 95 % of its errors inside the
95 % ellipsoid. A NEES above 1 means that the filter believes itself too much, below 1 too little.
The table of components says where: each number is the root mean square of an error over its own
sigma. The table of speeds says when: a prior of white noise on acceleration is too loose for a
robot that holds still, and too tight for one that jerks; so is a cubic between two knots.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Trajectory trials that no number was tuned on, and judge every ring.

    `quick`: six seconds of one.
    """
    wanted = in_worlds(trials(quick, seed))
    require_unseen(wanted)
    outcomes = run_campaign(wanted, out, jobs)
    claims, rings, components, speeds = [], [], [], []
    for world, robot in dict.fromkeys((trial.world, trial.robot) for trial in wanted):
        members = [
            one.trial
            for one in outcomes
            if (one.trial.world, one.trial.robot) == (world, robot) and one.summary is not None
        ]
        if not members:
            continue
        found, speed = pooled(out, members)
        claims += told(judge(robot, found), world)
        for name, ring in columns(found):
            label = {'robot': robot, 'ring': name}
            rings += column([{**label, **honesty(found, ring)}], world)
            components += column([{**label, **component_row(found, ring)}], world)
        speeds += column(speed_rows(robot, found, speed), world)
    claims.append(
        at_most('trials that failed', sum(one.summary is None for one in outcomes), '', 0)
    )
    tables = {
        'rings': rings,
        'components': components,
        'speeds': speeds,
        'trials': trial_rows(outcomes),
    }
    write_study(
        out,
        claims,
        seed=seed,
        settings={'trials': wanted},
        tables=tables,
        extra={
            'quick': quick,
            'hold_out': HOLD_OUT,
            'failed': {one.trial.name: one.error for one in outcomes if one.error},
        },
    )
    write_page(
        out,
        'Consistency',
        TEXT,
        claims,
        {
            'By ring': rings,
            'By component: RMS of error over sigma': components,
            'By speed of turning': speeds,
        },
    )
    return claims


def trials(quick: bool, seed: int) -> list[Trial]:
    """
    Ten engine trials, in the mapped scene and in one that differs from its map; ten soft arms.

    Each base sits where a draw from its stated spread puts it: a covariance that counts with this
    spread cannot be judged by a base that is exactly where it is said to be.
    """
    if quick:
        return [Trial('engine', 'S0', 't2', seed=seed, duration=6.0, drawn_base=True)]
    draws = [(names, k) for of_robot in PATHS for k, names in zip(range(DRAWS), cycle(of_robot))]
    return [Trial(*names, seed=seed + k, drawn_base=True) for names, k in draws]


def judge(robot: str, found: Errors) -> list[Claim]:
    """Judge the bounds, over all rings and for each."""
    claims = []
    for name, ring in columns(found):
        known = honesty(found, ring)
        claims += [
            between(f'{robot}, {name}: NEES per degree of freedom', known['NEES/dof'], '', *NEES),
            between(
                f'{robot}, {name}: coverage of the 95 % bound',
                0.01 * known['coverage [%]'],
                '',
                *COVERAGE,
            ),
        ]
    return claims


def columns(found: Errors) -> list[tuple[str, slice]]:
    """All rings, then each; the base is fixed by its mount."""
    each = [(name, slice(ring, ring + 1)) for ring, name in enumerate(found.names) if ring > 0]
    return [('all rings', slice(1, None)), *each]


def honesty(found: Errors, ring: slice) -> dict[str, float]:
    """Errors, NEES (mean, and median, which a few bad moments do not move) and coverage."""
    nees = found.nees[:, ring]
    known = np.isfinite(nees)
    return {
        'translation [mm]': 1e3 * float(np.mean(found.translation_m[:, ring])),
        'rotation [deg]': float(np.mean(found.rotation_deg[:, ring])),
        'NEES/dof': float(np.mean(nees[known])) / DOF,
        'median NEES/dof': float(np.median(nees[known])) / DOF,
        'coverage [%]': 100.0 * float(np.mean(known & (nees <= COVERAGE_BOUND))),
    }


def component_row(found: Errors, ring: slice) -> dict[str, float]:
    """RMS of each component's error over its sigma: 1 when honest."""
    normalised = found.pose[:, ring] / found.sigma[:, ring]
    return dict(
        zip(COMPONENTS, np.sqrt(np.nanmean(normalised**2, axis=(0, 1))).tolist(), strict=True)
    )


def speed_rows(robot: str, found: Errors, speed: np.ndarray) -> list[dict[str, Any]]:
    """NEES and coverage by the true speed of turning (K, R + 1) [rad/s]."""
    rows = []
    for low, high in zip(SPEEDS[:-1], SPEEDS[1:], strict=True):
        here = (speed[:, 1:] >= low) & (speed[:, 1:] < high) & np.isfinite(found.nees[:, 1:])
        nees = found.nees[:, 1:][here]
        if len(nees):
            rows.append(
                {
                    'robot': robot,
                    'turning [rad/s]': f'{low:g} to {high:g}',
                    'poses': len(nees),
                    'rotation [deg]': float(np.mean(found.rotation_deg[:, 1:][here])),
                    'NEES/dof': float(np.mean(nees)) / DOF,
                    'coverage [%]': 100.0 * float(np.mean(nees <= COVERAGE_BOUND)),
                }
            )
    return rows


def pooled(out: Path, members: Sequence[Trial]) -> tuple[Errors, np.ndarray]:
    """Chain the errors of several trials, and the true speed of turning (K, R + 1) [rad/s]."""
    parts, speeds = [], []
    for trial in members:
        result = load_run(out / 'trials' / trial.name).result
        parts.append(errors(settled(result.track), result.truth))
        speeds.append(turning(result.truth, parts[-1].stamps))
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ('stamps', 'translation_m', 'rotation_deg', 'pose', 'sigma', 'nees')
    }
    return Errors(names=parts[0].names, **arrays), np.concatenate(speeds)


def turning(truth: Trajectory, stamps: np.ndarray) -> np.ndarray:
    """(K, R + 1) true speed of turning [rad/s] at `stamps`, over SPAN round each."""
    from continuum_loc.lie import rotation_error_deg

    before, after = (
        np.clip(stamps + side * SPAN // 2, truth.stamps[0], truth.stamps[-1]) for side in (-1, 1)
    )
    turned = np.radians(
        rotation_error_deg(truth.at(before)[..., :3, :3], truth.at(after)[..., :3, :3])
    )
    return turned / ((after - before) / NANOSECONDS)[:, None]
