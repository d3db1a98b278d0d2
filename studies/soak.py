"""
Endurance of the live graph: half an hour at full rate; memory, latency and losses over time.

Simulator and estimator run as processes over real ROS 2 while the engine robot sways along its
trajectory, forth and back, so that time never jumps: 16 ToF sensors at 15 Hz, 5 IMUs at 100 Hz,
strain, insertion. After a first tenth, in which buffers and caches fill, memory has to stay flat
and latency must not grow; nothing may be lost, dropped or refused. The quick form lasts 40 s, once
forth and back: it shows that the graph keeps up, and says nothing about memory or growth.
`continuum-loc evaluate soak --minutes 7` shows the slope of memory, which the summary holds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
from continuum_loc.offline.live import LiveResult, run_live
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.simulator.plant import load_plant
from continuum_loc.simulator.trajectories import (
    Drive,
    Keyframe,
    REST,
    trajectory,
    TrajectoryFile,
)
import numpy as np
from studies.support.footprint import Footprint, MEBIBYTE
from studies.support.worlds import in_worlds, named, told
import yaml

ROBOT, SCENE, MOTION = 'engine', 'S0', 't1'
DURATION, QUICK_DURATION = 1800.0, 40.0  # s
PARTS = 10  # of the whole time; the first is the start-up
LONG_ENOUGH = 600.0  # s
FLAT = 0.05  # share by which memory may change
GROWTH = 0.10  # share by which latency may grow


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Claims of the study, with the course of memory, load and latency under `out`."""
    return soak(out, QUICK_DURATION if quick else DURATION, seed)


def soak(out: Path, duration: float, seed: int) -> list[Claim]:
    """
    Run the graph in every world for `duration` [s] each.

    Memory and growth are judged where that is long enough.
    """
    robot = load_robot(ROBOT)
    motion = trajectory(MOTION, robot, load_plant(robot.name))
    path = out.absolute() / 'sway.yaml'
    path.write_text(yaml.safe_dump(swaying(motion, duration).model_dump(mode='json')))
    claims, tables, extra = [], {}, {}
    for trial in in_worlds([Trial(ROBOT, SCENE, str(path), seed=seed, duration=duration)]):
        footprint, world = Footprint(period=1.0), trial.world
        live = run_live(out / named('graph', world), trial, record=False, watch=footprint)
        course = _course(live, footprint, duration)
        found = _flow_claims(live, robot, duration)
        found += _course_claims(course, footprint) if duration >= LONG_ENOUGH else []
        claims += told(found, world)
        tables[named('course', world)] = course
        extra[world] = _figures(live, footprint)
    write_study(
        out,
        claims,
        seed=seed,
        settings={'duration': duration, 'robot': ROBOT, 'scene': SCENE},
        tables=tables,
        extra=extra,
    )
    return claims


def _figures(live: LiveResult, footprint: Footprint) -> dict[str, Any]:
    """Delays, counts, load and the slope of memory of one run."""
    return {
        'latency_ms': live.latency_ms,
        'lag_ms': live.lag_ms,
        'step_ms': live.step_ms,
        'counts': live.counts,
        'lost': live.lost,
        'load': {node: footprint.mean_load(node) for node in footprint.cpu},
        'memory_mib_per_minute': {
            node: _growth_per_minute(footprint, node) for node in footprint.memory
        },
    }


def swaying(motion: Drive, duration: float) -> TrajectoryFile:
    """Repeat `motion` forth and back for at least `duration` seconds, without any jump."""
    steps = np.diff(motion.times)
    there = [*range(1, len(motion.times))]
    back = [*range(len(motion.times) - 2, -1, -1)]
    time, rows, times = REST, [0], [REST]
    while time < duration:
        for row in (*there, *back):
            time += float(steps[min(rows[-1], row)])
            rows.append(row)
            times.append(time)
    return TrajectoryFile(
        keyframes=tuple(
            Keyframe(
                time=at,
                tensions=tuple(motion.tensions[row].tolist()),
                insertion=float(motion.insertion[row]),
            )
            for at, row in zip(times, rows, strict=True)
        ),
        supported=motion.supported,
    )


def _course(live: LiveResult, footprint: Footprint, duration: float) -> list[dict[str, Any]]:
    """One row for each part of the time: memory and load of either node, latency of the poses."""
    latency = 1e3 * np.array(live.latencies_s)
    at = np.linspace(0.0, duration, len(latency))
    seen = np.array(footprint.times)
    rows = []
    for begin, end in _parts(duration):
        poses, samples = (at >= begin) & (at <= end), (seen >= begin) & (seen <= end)
        row = {'from [s]': begin, 'to [s]': end}
        for node in footprint.memory:
            memory = np.array(footprint.memory[node])[samples] / MEBIBYTE
            row[f'{node} memory [MiB]'] = float(np.median(memory))
            load = footprint.load(node)[samples[1:]]
            row[f'{node} load [%]'] = float(100.0 * np.mean(load))
        p10, p50, p95, p99 = np.percentile(latency[poses], (10, 50, 95, 99))
        rows.append(
            row
            | {
                'latency p10 [ms]': float(p10),
                'latency p50 [ms]': float(p50),
                'latency p95 [ms]': float(p95),
                'latency p99 [ms]': float(p99),
            }
        )
    return rows


def _parts(duration: float) -> list[tuple[float, float]]:
    edges = np.linspace(0.0, duration, PARTS + 1).tolist()
    return list(zip(edges, edges[1:], strict=False))


def _flow_claims(live: LiveResult, robot: RobotDescription, duration: float) -> list[Claim]:
    counts = live.counts['estimator']
    expected = robot.tof_model.rate * duration
    return [
        at_least(
            'poses published, of all that are due', len(live.latencies_s) / expected, '', 0.99
        ),
        at_most('messages lost on the way', sum(live.lost.values()), '', 0),
        at_most('messages dropped by the queue', sum(counts['dropped'].values()), '', 0),
        at_most('messages refused', sum(counts['refused'].values()), '', 0),
        at_most('failures and new starts', counts['failures'] + counts['restarts'], '', 0),
        at_most(
            'latency p50, of the time between two frames',
            live.latency_ms['p50'] * 1e-3 * robot.tof_model.rate,
            '',
            1.0,
        ),
    ]


def _course_claims(course: list[dict[str, Any]], footprint: Footprint) -> list[Claim]:
    """
    Memory and latency after the first part of the time, each as the share of its change.

    The tenth percentile of the latency is judged besides the median: what others do on a shared
    machine shows in the upper part of the distribution first.
    """
    settled = course[1:]
    claims = []
    for node in footprint.memory:
        memory = np.array([row[f'{node} memory [MiB]'] for row in settled])
        change = np.ptp(memory) / memory[0]
        claims.append(at_most(f'change of memory, {node}', 100.0 * change, '%', 100.0 * FLAT))
    for name in ('p10', 'p50'):
        latency = np.array([row[f'latency {name} [ms]'] for row in settled])
        claims.append(
            at_most(f'growth of latency {name}', 100.0 * _growth(latency), '%', 100.0 * GROWTH)
        )
    return claims


def _growth_per_minute(footprint: Footprint, node: str) -> float:
    """Slope of a node's memory by least squares, after the first part of the time [MiB/min]."""
    times = np.array(footprint.times)
    settled = times >= times[-1] / PARTS
    memory = np.array(footprint.memory[node])[settled] / MEBIBYTE
    return float(60.0 * np.polyfit(times[settled], memory, 1)[0])


def _growth(values: np.ndarray) -> float:
    """Growth along the line of least squares, from first to last, as a share of the mean."""
    slope = np.polyfit(np.arange(len(values)), values, 1)[0]
    return float(slope * (len(values) - 1) / values.mean())
