"""
The filter on the engine robot at full sensor rate, on one core.

16 ToF of 64 zones, 5 gyros, strain.

`run(quick)` gives the time per second of data (its inverse is the real-time factor) and the
percentiles of a step, over trajectory t2 in S0, in processor time; `wall_s` is what the clock on
the wall said. Nothing comparable exists to be put beside it: its least squares is beside gtsam's
in `window`, and what a step costs against the problem's size is in `sizes`.
"""

from __future__ import annotations

import gc
from time import perf_counter, process_time

from bench.harness import alone, one_core
from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.measurements import Measurement, seconds
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import measured, Trial
from continuum_loc.robot import load_robot
import numpy as np

# What is meant to hold: a real-time factor of 5, and half a ToF period.
BOUNDS = [
    ('engine, a second of data', 'ours_s', 'at most', 0.2),
    ('engine, step p99', 'ours_s', 'at most', 0.033),
]


def run(quick: bool = False) -> list[dict]:
    """Rows of name, ours_s and wall_s; the first replay, which may compile, is not counted."""
    samples = measured(Trial('engine', 'S0', 't2', duration=4.0 if quick else 20.0))
    with one_core():
        _replayed(samples[: len(samples) // 8])
        gc.collect()
        gc.freeze()  # as a node does after its rehearsal
        whole, steps = _replayed(samples)
    per_second = whole / seconds(samples[-1].stamp, samples[0].stamp)
    found = [('engine, a second of data', per_second)]
    found += [(f'engine, step p{q}', np.percentile(steps, q, axis=0)) for q in (50, 95, 99)]
    return [alone(name, processor, wall_s=float(wall)) for name, (processor, wall) in found]


def _replayed(samples: list[Measurement]) -> tuple[np.ndarray, np.ndarray]:
    """Time (2,) of all samples and (N, 2) of each step [s], of the processor and on the wall."""
    estimator = make_filter(
        load_robot('engine'), scene_map('S0'), load_estimator_settings('engine')
    )
    whole, steps = np.zeros(2), []
    for sample in samples:
        before = process_time(), perf_counter()
        estimate = estimator.process(sample)
        spent = np.subtract((process_time(), perf_counter()), before)
        whole += spent
        if estimate is not None:
            steps.append(spent)
    return whole, np.array(steps)


if __name__ == '__main__':
    for row in run():
        print(row)
