"""
What a step of the filter costs, and what it keeps, against each size of the problem.

`run(quick)` gives, for the engine robot in S0 along t2 on one core, the processor time of a step
while one size changes and the others stay: knots of the window, zones (by whole sensors), nodes
along the body, points of the map; the time of a whole run against its duration; and of a lookup
against the size of the map. `size` is that size, `exponent` the slope of log time over log size,
fitted to all rows of the group: 1 is linear, 0 is independent. `memory_bytes` is what the map's
index takes, and for the durations the resident size of the process at the end of each.

The maps are random samples of the surface: blue noise of 5 million points takes an hour to make,
and a lookup does not mind.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import time

from bench.harness import alone, one_core
from continuum_loc.estimator import SlidingWindowFilter
from continuum_loc.estimator.settings import EstimatorSettings, load_estimator_settings
from continuum_loc.mapping.facing import PATIENCE
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
from continuum_loc.measurements import Measurement, NANOSECONDS, TofFrame
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import measured, Trial
from continuum_loc.robot import load_robot
from continuum_loc.simulator.scenes import load_scene
import numpy as np

BOUNDS = [
    ('size, knots', 'exponent', 'at most', 1.15),
    ('size, zones', 'exponent', 'at most', 1.15),
    ('size, duration', 'exponent', 'at most', 1.15),
    ('size, map points', 'exponent', 'at most', 0.15),
]
SETTLED = 1.5  # [s] of data before a step counts: by then the window is full
WINDOWS, SPACINGS, SENSORS = (0.6, 1.0, 2.0, 4.0), (0.32, 0.16, 0.08, 0.04), (4, 8, 16)
MAPS = (50_000, 500_000, 5_000_000)


def run(quick: bool = False) -> list[dict]:
    """Rows of name, ours_s (per step, run or lookup), size, exponent and memory_bytes."""
    duration = 2.5 if quick else 8.0
    samples = measured(Trial('engine', 'S0', 't2', duration=duration))
    settings, prior = load_estimator_settings('engine'), scene_map('S0')
    with one_core():
        _step(samples[: len(samples) // 4], prior, settings, settled=0.0)  # compiles
        rows = [*_filter_groups(samples, prior, settings, quick)]
        rows += _durations(samples, prior, settings, duration)
        rows += _maps(samples, settings, quick)
    return rows


def _filter_groups(
    samples: list[Measurement], prior: PriorMap, settings: EstimatorSettings, quick: bool
) -> Iterator[dict]:
    def changed(name: str, values: tuple[float, ...]) -> list[tuple[SlidingWindowFilter, float]]:
        return [
            _step(samples, prior, settings.model_copy(update={name: value}))
            for value in (values[:2] if quick else values)
        ]

    found = changed('window', WINDOWS)
    yield from _group('knots', [(len(filter_.window.columns), s) for filter_, s in found])
    found = changed('node_spacing', SPACINGS)
    yield from _group('nodes', [(filter_.grid.nodes, s) for filter_, s in found])
    names = [sensor.name for sensor in load_robot('engine').tof]
    yield from _group(
        'zones',
        [(64 * n, _step(_hearing(samples, names[:n]), prior, settings)[1]) for n in SENSORS],
    )


def _hearing(samples: list[Measurement], names: list[str]) -> list[Measurement]:
    """Leave out what other ToF sensors measured."""
    return [one for one in samples if not isinstance(one, TofFrame) or one.sensor in names]


def _step(
    samples: list[Measurement],
    prior: PriorMap,
    settings: EstimatorSettings,
    settled: float = SETTLED,
) -> tuple[SlidingWindowFilter, float]:
    """Run a filter; it, and its processor time per step once it has settled."""
    filter_ = SlidingWindowFilter(load_robot('engine'), prior, settings)
    begin, steps, started = samples[0].stamp + round(settled * NANOSECONDS), 0, None
    for sample in samples:
        if started is None and sample.stamp >= begin:
            started = time.process_time()
        steps += filter_.process(sample) is not None and started is not None
    return filter_, (time.process_time() - started) / max(steps, 1)


def _durations(
    samples: list[Measurement], prior: PriorMap, settings: EstimatorSettings, duration: float
) -> list[dict]:
    """Time a run up to a quarter, a half and all of the data; its resident size there."""
    filter_, started, spent, memory = (
        SlidingWindowFilter(load_robot('engine'), prior, settings),
        time.process_time(),
        [],
        [],
    )
    marks = [duration / 4.0, duration / 2.0, duration]
    ends = [samples[0].stamp + round(mark * NANOSECONDS) for mark in marks[:-1]]
    for sample in samples:
        if len(spent) < len(ends) and sample.stamp >= ends[len(spent)]:
            spent.append(time.process_time() - started)
            memory.append(_resident())
        filter_.process(sample)
    spent.append(time.process_time() - started)
    memory.append(_resident())
    return _group('duration', list(zip(marks, spent, strict=True)), memory)


def _maps(samples: list[Measurement], settings: EstimatorSettings, quick: bool) -> list[dict]:
    """Time a step, and a lookup for 1000 beams near the surface that was made before."""
    steps, lookups, memory = [], [], []
    for points in MAPS[:2] if quick else MAPS:
        prior = _random_map(points)
        filter_, seconds = _step(samples, prior, settings)
        index = filter_.setup.index
        steps.append((points, seconds))
        lookups.append((points, _lookup(prior, index)))
        memory.append(sum(a.nbytes for a in index.arrays if isinstance(a, np.ndarray)))
    return [
        *_group('map points, filter step', steps, memory),
        *_group('map points, lookup', lookups, memory),
    ]


def _lookup(prior: PriorMap, index: VoxelIndex) -> float:
    """Time what the filter asks: the nearest point that faces the beam, where beams have been."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(prior), 1000)
    places, beams = prior.points[rows] + rng.normal(0, 0.005, (1000, 3)), -prior.normals[rows]
    for _ in range(PATIENCE + 1):
        index.nearest_facing(places, beams, 0.1, 0.1)
    times = []
    for _ in range(50):
        started = time.process_time()
        index.nearest_facing(places, beams, 0.1, 0.1)
        times.append((time.process_time() - started) / len(places))
    return float(np.median(times))


def _random_map(count: int) -> PriorMap:
    import trimesh

    scene = load_scene('S0')
    mesh = trimesh.Trimesh(scene.vertices, scene.faces, process=False)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    return PriorMap(
        points, mesh.face_normals[faces], np.ones(count), spacing=float(np.sqrt(mesh.area / count))
    )


def _group(
    name: str, found: list[tuple[float, float]], memory: list[int] | None = None
) -> list[dict]:
    """Rows of one size, each with the exponent fitted to all of them."""
    sizes, seconds = np.array(found, float).T
    exponent = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
    return [
        alone(
            f'size, {name} {size:,g}',
            spent,
            size=float(size),
            exponent=exponent,
            memory_bytes=None if memory is None else int(memory[k]),
        )
        for k, (size, spent) in enumerate(found)
    ]


def _resident() -> int:
    """Resident size of this process now [bytes]."""
    return 1024 * int(
        Path('/proc/self/status').read_text().split('VmRSS:')[1].split(maxsplit=1)[0]
    )


if __name__ == '__main__':
    for row in run():
        print(row['name'], row['ours_s'], row['exponent'], row['memory_bytes'])
