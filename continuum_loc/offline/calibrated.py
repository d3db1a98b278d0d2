"""`continuum-loc calibrate`: a robot's description from its bags, and a report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from continuum_loc.calibration.batch import calibrate, Calibration, TOLD
from continuum_loc.estimator.parameters import PARTS
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.offline.replay import samples_of
from continuum_loc.robot import RobotDescription, Tolerances
from continuum_loc.settings import dump_settings
import numpy as np

# Which tolerance says how far parts of a kind may be off, and its unit over that of theta.
TOLERANCES = {
    'mount': (('mount_position', slice(0, 3), 1.0), ('mount_rotation_deg', slice(3, 6), 'deg')),
    'range': (('range_offset', slice(0, 1), 1.0), ('range_scale', slice(1, 2), 1.0)),
    'gyro': (('gyro_scale', [0, 4, 8], 1.0), ('gyro_axes_deg', [1, 2, 3, 5, 6, 7], 'deg')),
    'strain': (
        ('strain_scale', slice(0, 1), 1.0),
        ('strain_twist_deg', slice(1, 2), 'deg'),
        ('strain_offset', slice(2, 4), 1.0),
    ),
    'clock': (('clock', slice(0, 1), 1.0),),
    'delay': (('delay', slice(0, 1), 1.0),),
    'base': (('base_position', slice(0, 3), 1.0), ('base_rotation_deg', slice(3, 6), 'deg')),
    'map': (('map_position', slice(0, 3), 1.0), ('map_rotation_deg', slice(3, 6), 'deg')),
    'length': (('length', slice(0, 1), 1.0),),
}
# What motion would show constants of a kind that the recordings do not.
HINTS = {
    'mount': 'turn and insert the body so that the sensor sees walls from several sides',
    'range': 'let the sensor see walls at several distances and slants',
    'gyro': 'turn the ring about all of its axes',
    'strain': 'bend to both sides, in two planes',
    'clock': 'move faster, and change direction',
    'delay': 'move faster, and change direction',
    'base': 'let the rings near the base see walls in three directions',
    'map': 'bring a tracker or the truth',
    'length': 'see a wall ahead while bent and while straight',
}


def calibrate_bags(
    robot: RobotDescription,
    prior_map: PriorMap | None,
    bags: Sequence[Path],
    settings: EstimatorSettings,
    reference: str,
    progress: Callable[[str, float], None],
) -> Calibration:
    """Calibrate a robot from bags; raises BagError and CalibrationError."""
    streams = [list(samples_of(bag)) for bag in bags]
    return calibrate(robot, prior_map, streams, settings, reference, progress)


def tolerances_left(found: Calibration, least: float) -> Tolerances:
    """
    Say how far a calibrated robot may still be off: root mean squares over its parts.

    least: share of its tolerance that is left of each at any rate, as what the model misses does
    not average out.
    """
    left = found.robot.tolerances.model_dump()
    for kind, tolerances in TOLERANCES.items():
        sigmas = [found.sigma[one.at] for one in found.parameters.blocks if one.kind == kind]
        for name, part, unit in tolerances if sigmas else ():
            rms = float(np.sqrt(np.mean(np.square(np.array(sigmas)[:, part]))))
            rms = float(np.degrees(rms)) if unit == 'deg' else rms
            left[name] = min(float(np.hypot(rms, least * left[name])), left[name])
    return Tolerances(**left)


def write_calibration(found: Calibration, least: float, out: Path) -> list[Path]:
    """Write the description, the whole covariance (`.npz`) and a report (`.md`); their paths."""
    robot = found.robot.model_copy(update={'tolerances': tolerances_left(found, least)})
    covariance, report = out.with_suffix('.calibration.npz'), out.with_suffix('.calibration.md')
    dump_settings(robot, out)
    with covariance.open('wb') as stream:
        np.savez(
            stream, names=found.parameters.names, theta=found.theta, covariance=found.covariance
        )
    report.write_text(told(found))
    return [out, covariance, report]


def told(found: Calibration) -> str:
    """Say in Markdown what was found, how well, and what the recordings do not show."""
    lines = [
        f'# Calibration of {found.robot.name}',
        '',
        f'{len(found.cost)} iterations, cost {found.cost[0]:.0f} to {found.cost[-1]:.0f}; '
        + ('converged.' if found.converged else 'not converged: more or other motion may help.'),
        '',
        '| constant | before | found | sigma | told |',
        '|---|---|---|---|---|',
    ]
    for block in found.parameters.blocks:
        parts = zip(
            PARTS[block.kind],
            block.sigma,
            found.theta[block.at],
            found.sigma[block.at],
            found.told(block),
            strict=True,
        )
        for part, before, value, sigma, share in parts:
            scale, unit = _unit(block.kind, part)
            name = f'{block.name} {block.kind} {part}'.strip()
            lines.append(
                f'| {name} | 0 +- {scale * before:.2f} {unit} | {scale * value:.2f} | '
                f'{scale * sigma:.2f} | {100.0 * max(share, 0.0):.0f} % |'
            )
    return '\n'.join([*lines, '', *_unseen(found)]) + '\n'


def _unseen(found: Calibration) -> list[str]:
    """List by kind what keeps its tolerance, and what motion would show it."""
    lines = ['## What these recordings do not show', '']
    for kind, hint in HINTS.items():
        blocks = [one for one in found.parameters.blocks if one.kind == kind]
        count = sum(int(np.sum(found.told(one) < TOLD)) for one in blocks)
        if count:
            total = sum(len(one.sigma) for one in blocks)
            lines.append(f'- {kind}: {count} of {total} keep most of their tolerance; {hint}.')
    return lines if len(lines) > 2 else [*lines, 'Everything was told.']


def _unit(kind: str, part: str) -> tuple[float, str]:
    """Give the factor and the unit in which a person reads a constant."""
    if kind in ('clock', 'delay'):
        return 1e3, 'ms'
    if kind == 'length' or part == 'scale' or kind == 'gyro':
        return 1e2, '%'
    if part in ('rx', 'ry', 'rz', 'twist'):
        return float(np.degrees(1.0)), 'deg'
    return (1e3, 'mm') if kind in ('mount', 'range', 'base', 'map') else (1.0, '1/m')
