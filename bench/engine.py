"""
The filter on the engine robot at full sensor rate, on one core.

16 ToF of 64 zones, 5 gyros, strain.

`run(quick)` gives the time per second of data and the percentiles of a step, over trajectory t2 in
S0, and what a step costs with longer windows, more nodes and larger maps. Nothing comparable
exists to be put beside it here.
"""

from __future__ import annotations

from collections.abc import Iterator

from continuum_loc.estimator.settings import EstimatorSettings, load_estimator_settings
from continuum_loc.evaluation.bench import one_core
from continuum_loc.evaluation.replay import replay, ReplayResult
from continuum_loc.evaluation.trials import make_filter, scene_map, simulate, Trial
from continuum_loc.measurements import Measurement
from continuum_loc.robot import load_robot
import numpy as np

# What is meant to hold: a real-time factor of 5, and half a ToF period.
BOUNDS = [
    ('engine, a second of data', 'ours_s', 'at most', 0.2),
    ('engine, step p99', 'ours_s', 'at most', 0.033),
]
SIZES = {'window': (0.5, 1.0, 2.0), 'node_spacing': (0.32, 0.16, 0.08)}
MAPS = (30_000, 300_000, 3_000_000)


def run(quick: bool = False) -> list[dict]:
    """Rows of name and ours_s; the first replay, which may compile, is not counted."""
    samples = list(simulate(Trial('engine', 'S0', 't2', duration=4.0 if quick else 20.0)))
    settings = load_estimator_settings('engine')
    with one_core():
        _replayed(samples[: len(samples) // 8], settings)
        result = _replayed(samples, settings)
        rows = [
            _row('engine, a second of data', 1.0 / result.real_time_factor),
            _row('engine, processor time of it', result.cpu_seconds / result.data_seconds),
        ]
        rows += [
            _row(f'engine, step p{q}', float(np.percentile(result.step_seconds, q)))
            for q in (50, 95, 99)
        ]
        if not quick:
            rows += list(_sizes(samples, settings))
    return rows


def _sizes(samples: list[Measurement], settings: EstimatorSettings) -> Iterator[dict]:
    """Median step while one size changes and the others stay."""
    for name, values in SIZES.items():
        for value in values:
            changed = settings.model_copy(update={name: value})
            yield _row(
                f'engine, step p50, {name} {value:g}', _median_step(_replayed(samples, changed))
            )
    for points in MAPS:
        yield _row(
            f'engine, step p50, map of {points:,} points',
            _median_step(_replayed(samples, settings, points)),
        )


def _replayed(
    samples: list[Measurement], settings: EstimatorSettings, points: int = 300_000
) -> ReplayResult:
    return replay(samples, make_filter(load_robot('engine'), scene_map('S0', points), settings))


def _median_step(result: ReplayResult) -> float:
    return float(np.median(result.step_seconds))


def _row(name: str, seconds: float) -> dict:
    return {
        'name': name,
        'ours_s': seconds,
        'peer': None,
        'peer_s': None,
        'ratio': None,
        'spread': None,
    }
