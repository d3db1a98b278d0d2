"""Starts from nothing, and a robot that is kidnapped: one draw each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
import time as clock
from typing import Any

from continuum_loc import lie
from continuum_loc.measurements import BaseSample, NANOSECONDS, nanoseconds, TruthSample
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.replay import one_thread, samples_of
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.robot import load_robot, RobotDescription
import numpy as np
from scipy.spatial.transform import Rotation

REACH, TURN = 0.5, 30.0  # m, deg: of a guess from the truth, and of the region
ANYWHERE = (100.0, 180.0)
SCENES = {'engine': 'S0', 'soft_arm': 'R1'}
START_CASES = (
    ('engine', 'within 0.5 m and 30 deg'),
    ('soft_arm', 'within 0.5 m and 30 deg'),
    ('engine', 'anywhere'),
    ('soft_arm', 'anywhere'),
)
PATIENCE = 5.0  # [s] of data in which a start has to be found
WRONG = 0.05  # [m] an answer farther off at any ring is a wrong one
LATEST = 4.5  # [s] into the recording a start is drawn
TRACKED = 2.0  # [s] before a robot is kidnapped


def started(case: tuple[str, str], bag: Path, seed: int) -> dict[str, Any]:
    """Start at a drawn instant of a recording, with a drawn guess of the base."""
    (name, what), rng = case, np.random.default_rng(seed)
    samples = list(_from(bag, rng.uniform(0.0, LATEST), PATIENCE))
    first = next(one for one in samples if isinstance(one, TruthSample)).T_map_ring[0]
    region = ANYWHERE if what == 'anywhere' else (REACH, TURN)
    result = _run(_described(name, first, region, rng), SCENES[name], samples)
    return {'case': f'{name}, {what}', **result}


def kidnap(before: Path, after: Path, seed: int) -> dict[str, Any]:
    """Let it track, then wake it elsewhere: in the recording of a carried base, later on."""
    rng = np.random.default_rng(seed)
    one = list(_from(before, rng.uniform(0.0, LATEST), TRACKED))
    other = list(_from(after, rng.uniform(2.5, LATEST), PATIENCE))
    gap = one[-1].stamp + nanoseconds(0.01) - other[0].stamp
    moved = [replace(sample, stamp=sample.stamp + gap) for sample in other]
    first = next(sample for sample in one if isinstance(sample, TruthSample)).T_map_ring[0]
    robot = _described('engine', first, (REACH, TURN), rng)
    result = _run(robot, 'S0', chain(one, moved), moved[0].stamp)
    return {'case': 'engine, kidnapped', **result}


def _from(bag: Path, start: float, duration: float) -> Iterator[Any]:
    """Yield the samples of a stretch of a bag, but for what is told of the base."""
    epoch = None
    for sample in samples_of(bag):
        epoch = sample.stamp if epoch is None else epoch
        time = (sample.stamp - epoch) / NANOSECONDS
        if start <= time < start + duration and not isinstance(sample, BaseSample):
            yield sample


def _described(
    name: str, T_map_base: np.ndarray, region: tuple[float, float], rng: np.random.Generator
) -> RobotDescription:
    """Describe a robot whose free base is guessed up to REACH and TURN off; it is not inserted."""
    robot = load_robot(name)
    shift, turn = rng.normal(size=(2, 3))
    shift *= REACH * np.cbrt(rng.random()) / np.linalg.norm(shift)
    turn *= np.radians(TURN) * rng.random() / np.linalg.norm(turn)
    R = lie.so3_exp(turn) @ T_map_base[:3, :3]
    told = {
        'mode': 'free',
        'region': region,
        'insertion': {'mode': 'fixed'},
        'xyz': tuple((T_map_base[:3, 3] + shift).tolist()),
        'rpy_deg': tuple(Rotation.from_matrix(R).as_euler('xyz', degrees=True).tolist()),
    }
    base = type(robot.base).model_validate(robot.base.model_dump() | told)
    return robot.model_copy(update={'base': base})


def _run(robot: RobotDescription, scene: str, samples: Any, moved: int = 0) -> dict[str, Any]:
    """
    Feed samples until a body is told, after the stamp `moved` where there is one.

    An answer is an estimate whose status is `tracking`; every wrong one counts.
    """
    filter_ = make_filter(robot, scene_map(scene))
    truth: np.ndarray | None = None
    first, cpu, wrong = None, 0.0, 0
    result: dict[str, Any] = {'found': False, 'wrong': 0}
    with one_thread():
        for sample in samples:
            if isinstance(sample, TruthSample):
                truth = sample.T_map_ring
                continue
            first = sample.stamp if first is None or sample.stamp == moved else first
            begun = clock.process_time()
            estimate = filter_.process(sample)
            cpu += clock.process_time() - begun
            if estimate is None or truth is None:
                continue
            if sample.stamp < moved:
                cpu = 0.0
                continue
            if estimate.status == 'lost' and 'noticed [s]' not in result:
                result['noticed [s]'] = (estimate.stamp - moved) / NANOSECONDS
            if estimate.status != 'tracking' or estimate.stamp < moved:
                continue
            off = np.linalg.norm((estimate.T_map_ring - truth)[:, :3, 3], axis=1).max()
            wrong += bool(off > WRONG)
            if off <= WRONG:
                data = (estimate.stamp - max(moved, first)) / NANOSECONDS
                found = {'data [s]': data, 'computing [s]': cpu, 'error [cm]': 100.0 * off}
                return result | found | {'found': True, 'wrong': int(wrong > 0)}
    return result | {'wrong': int(wrong > 0)}
