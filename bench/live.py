"""
The live graph over real ROS 2: what it takes of the processor, and how fresh its poses are.

Simulator and estimator run as processes of their own: the engine robot with 16 ToF sensors at
15 Hz, 5 IMUs at 100 Hz, strain and insertion. Latency runs from the stamp of the ToF frames to the
pose's publication, all transport included. Nothing else does this, so there is no peer; what the
simulator takes is told beside, as a real robot's drivers would take its place.
"""

from __future__ import annotations

from pathlib import Path
import tempfile

BOUNDS = [
    ('live, latency from ToF stamp to pose, p95', 'ours_s', 'at most', 0.0667),
    ('live, processor time of the estimator', 'ours_s', 'at most', 1.0),
]
DURATION, QUICK_DURATION = 20.0, 8.0  # s


def run(quick: bool = False) -> list[dict]:
    """Rows of name and ours_s; `rate_hz` where a row is about messages."""
    from bench.harness import alone
    from continuum_loc.offline.live import run_live
    from continuum_loc.offline.trials import Trial
    from studies.support.footprint import Footprint

    footprint = Footprint(period=0.5)
    with tempfile.TemporaryDirectory() as scratch:
        live = run_live(
            Path(scratch),
            Trial(duration=QUICK_DURATION if quick else DURATION),
            record=False,
            watch=footprint,
        )
    seconds = footprint.times[-1] - footprint.times[0]
    rows = [
        alone(f'live, latency from ToF stamp to pose, {name}', live.latency_ms[name] * 1e-3)
        for name in ('p50', 'p95', 'p99')
    ]
    rows += [
        alone(f'live, processor time of the {node} per second', footprint.mean_load(node))
        for node in ('estimator', 'simulator')
    ]
    rows.append(alone('live, filter step and publication, mean', live.step_ms['mean'] * 1e-3))
    received = sum(live.counts['estimator']['received'].values())
    for name, count in (('messages received', received), ('poses', len(live.latencies_s))):
        rate = count / (QUICK_DURATION if quick else DURATION)
        rows.append(alone(f'live, between {name}', 1.0 / rate, rate_hz=rate))
    lost = sum(live.lost.values()) + sum(live.counts['estimator']['dropped'].values())
    return [row | {'lost': lost, 'watched_s': seconds} for row in rows]
