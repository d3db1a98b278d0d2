"""
Draw where the time of a filter step goes (make profile).

The engine robot's filter at full sensor rate under cProfile, which sees compiled kernels and
LAPACK as one function each: time of their own, gathered into parts, in milliseconds per step. An
argument names another picture file.
"""

from __future__ import annotations

import cProfile
from pathlib import Path
import pstats
import sys
from time import process_time

from bench.harness import one_core
from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import measured, Trial
from continuum_loc.robot import load_robot
from matplotlib.figure import Figure

PICTURE = Path(__file__).parents[1] / 'docs/pictures/step_profile.png'
DURATION = 8.0  # [s] of data, of which the first quarter is not counted
OTHERS = 'Python in between'
ANY = ''
# Part: ends of (file, function); the first that fits. Built-ins have no file.
PARTS = {
    'ToF: matching and information': [('tof.py', '_add')],
    'strain': [('factors/strain.py', '_add')],
    'gyro': [('factors/gyro.py', '_add')],
    'priors': [('priors.py', '_add')],
    'elimination, solves, covariances': [('chain.py', ANY)],
    'ToF: reading frames': [('tof.py', 'row'), ('tof.py', '_read')],
    'stacking of batches': [('tof.py', 'stack'), ('strain.py', 'stack'), ('gyro.py', 'stack')],
}


def main(picture: Path) -> None:
    """Profile, print the parts and draw them."""
    samples = measured(Trial('engine', 'S0', 't2', duration=DURATION))
    estimator = make_filter(
        load_robot('engine'), scene_map('S0'), load_estimator_settings('engine')
    )
    profile, steps = cProfile.Profile(process_time), 0
    with one_core():
        for k, sample in enumerate(samples):
            if k == len(samples) // 4:
                profile.enable()
            steps += estimator.process(sample) is not None and k >= len(samples) // 4
        profile.disable()
    parts = dict.fromkeys([*PARTS, OTHERS], 0.0)
    for (file, _, function), (_, _, own, _, _) in pstats.Stats(profile).stats.items():
        parts[_part(file, function)] += 1e3 * own / steps
    whole = sum(parts.values())
    for name, spent in parts.items():
        print(f'{name:32s} {spent:6.2f} ms {spent / whole:5.0%}')
    print(f'{"a step":32s} {whole:6.2f} ms, {steps} steps')
    _draw(parts, whole, picture)


def _part(file: str, function: str) -> str:
    for name, members in PARTS.items():
        if any(file.endswith(end) and member in (ANY, function) for end, member in members):
            return name
    return OTHERS


def _draw(parts: dict[str, float], whole: float, picture: Path) -> None:
    names = sorted(parts, key=parts.get)
    figure = Figure(figsize=(7.0, 3.2), layout='constrained')
    axes = figure.add_subplot()
    bars = axes.barh(names, [parts[name] for name in names], color='tab:blue')
    axes.bar_label(bars, [f' {parts[name] / whole:.0%}' for name in names])
    axes.set_xlabel('own time [ms per step], under the profiler')
    axes.set_title(f'A step of the filter, engine robot: {whole:.1f} ms', fontsize=10)
    axes.spines[['top', 'right']].set_visible(False)
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=110)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE)
