"""
The simulator on one core: the live engine robot in S0, contacts on, 16 ToF of 64 zones at 15 Hz.

`run(quick)` gives the processor time of a second of data for both ToF fidelities, without ToF, and
without a scene. Nothing comparable exists to be put beside it here; `bench/raycast.py` has the
rays beside MuJoCo's.
"""

from __future__ import annotations

from bench.harness import alone, one_core
from continuum_loc.robot import load_robot
from continuum_loc.simulator.scenes import load_scene
from continuum_loc.simulator.world import World
from studies.simulator import seconds_of_processor

# What is meant to hold: 1.5 times real time.
BOUNDS = [('vl53l5cx, trajectory', 'ours_s', 'at most', 1.0 / 1.5)]


def run(quick: bool = False) -> list[dict]:
    """Rows of name and ours_s, in processor time: what else the machine does is not counted."""
    robot, scene = load_robot('engine'), load_scene('S0')
    blind = robot.model_copy(update={'tof': ()})
    paths = ('t3',) if quick else ('t1', 't2', 't3')
    worlds = {
        f'live engine in S0, {fidelity}, trajectory {path}': World(
            robot, scene, path, tof_fidelity=fidelity
        )
        for fidelity in ('paper', 'vl53l5cx')
        for path in paths
    }
    worlds['live engine in S0, no ToF, t3'] = World(blind, scene, 't3')
    worlds['live engine in empty space, t3'] = World(robot, None, 't3')
    with one_core():
        return [
            alone(name, seconds_of_processor(world, 3.0 if quick else 20.0))
            for name, world in worlds.items()
        ]
