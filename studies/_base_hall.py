"""The Hall arm on a wrist: its arc against the same arm on a base that stands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from continuum_loc import lie
from continuum_loc.measurements import BaseSample, TruthSample
from continuum_loc.offline.shape_replay import ShapeReplay
from continuum_loc.offline.trials import TOLD, with_base
from continuum_loc.robot import load_robot
from continuum_loc.shape import ShapeSettings
from continuum_loc.simulator.carrier import carrier, Told
from continuum_loc.simulator.world import World
import numpy as np

TRAJECTORY, DURATION = 'free1', 14.0
NEAR = 3_000_000  # ns: an estimate has the truth of an instant so close
EXACT = Told(
    error_position=0.0, error_rotation_deg=0.0, noise_position=0.0, noise_rotation_deg=0.0
)
# What carries the base, what is told of it, and what the description says.
CASES = {
    'stands': ('still', EXACT, 'fixed'),
    'carried': ('wrist', Told(**TOLD['arm']), 'measured'),
    'carried, latency not told': ('wrist', Told(**TOLD['arm']), 'untold latency'),
    'carried, told exactly': ('wrist', EXACT, 'untold latency'),
    'carried, constant R_0^W': ('wrist', EXACT, 'fixed'),
}


def hall_rows(seeds: Iterable[int], duration: float = DURATION) -> list[dict[str, Any]]:
    """One row per case and seed: errors of the modules' places relative to the base."""
    return [
        {'base': name, 'seed': seed, **_errors(*CASES[name], seed, duration)}
        for seed in seeds
        for name in CASES
    ]


def _errors(carried: str, told: Told, base: str, seed: int, duration: float) -> dict[str, float]:
    robot = load_robot('hall_arm')
    true, described = with_base(robot, 'measured'), with_base(robot, base)
    world = World(true, None, TRAJECTORY, carried=carrier(carried, true, told), seed=seed)
    estimator = ShapeReplay(described, ShapeSettings())
    truth: dict[int, np.ndarray] = {}
    estimates = []
    for sample in world.run(duration):
        if isinstance(sample, TruthSample):
            truth[sample.stamp] = sample.T_map_ring
        elif not isinstance(sample, BaseSample) or described.base.mode == 'measured':
            estimate = estimator.process(sample)
            if estimate is not None:
                estimates.append(estimate)
    stamps = np.array(sorted(truth), np.int64)
    found = []
    for one in estimates:
        nearest = stamps[np.argmin(np.abs(stamps - one.stamp))]
        if abs(nearest - one.stamp) < NEAR:
            true_ring = truth[nearest]
            arc = lie.inverse(one.T_map_ring[0]) @ one.T_map_ring[1:]
            true_arc = lie.inverse(true_ring[0]) @ true_ring[1:]
            found.append(np.linalg.norm((arc - true_arc)[:, :3, 3], axis=1))
    error = 1e3 * np.array(found)
    return {
        'mean [mm]': error.mean(),
        'tip module [mm]': error[:, -1].mean(),
        'most [mm]': error.max(),
    }
