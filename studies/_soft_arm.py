"""
Trials of Tables III and IV: the soft arm in the box.

Every map with every scene that differs by one object.
"""

from __future__ import annotations

from continuum_loc.offline.trials import Trial
from studies.support.worlds import DISTURBED, IDEAL, WORLDS

# 23 trajectories over five scenes, at least four in each; with the 13 pairs below that makes 61
# combinations. The last one in R1, R2 and R3 swings the arm against what stands there.
TRAJECTORIES = {
    'R0': ('b1', 'b2', 'b3', 'b4'),
    'R1': ('b1', 'b2', 'b3', 'b4', 'b6'),
    'R2': ('b1', 'b2', 'b3', 'b4', 'b7'),
    'R3': ('b1', 'b2', 'b3', 'b4', 'b8'),
    'R4': ('b1', 'b2', 'b3', 'b4'),
}
MATCHING = tuple((f'R{k}', f'R{k}') for k in range(5))
# (map, scene): the scene has one more object.
ADDED = tuple((f'R{k}', f'R{k + 1}') for k in range(4))
REMOVED = tuple((f'R{k + 1}', f'R{k}') for k in range(4))
# `paper`: one ray per zone. `vl53l5cx`: the sensor as it is, with mounting errors, clock offset
# and gyro bias. `disturbed`: the world of that name, its sensors among all that departs.
CONDITIONS = {
    'paper': {},
    'vl53l5cx': {'fidelity': 'vl53l5cx', 'disturbed': True},
    'disturbed': {'world': DISTURBED},
}


def conditions() -> tuple[str, ...]:
    """Names of the conditions in the worlds that are asked for."""
    return tuple(
        name for name, told in CONDITIONS.items() if told.get('world', IDEAL) in WORLDS.get()
    )


def condition(trial: Trial) -> str:
    """Name the condition of a trial."""
    return DISTURBED if trial.world == DISTURBED else trial.fidelity


def soft_arm_trials(quick: bool, seed: int) -> list[Trial]:
    """
    All 61 combinations in every condition.

    `quick`: four seconds of one trajectory, one pair of each kind.
    """
    if quick:
        return [
            Trial(
                'soft_arm',
                scene,
                'b2',
                map_scene,
                **CONDITIONS[name],
                seed=seed,
                duration=4.0,
            )
            for name in conditions()
            for map_scene, scene in (MATCHING[1], ADDED[0], REMOVED[1])
        ]
    # Every scene and trajectory has noise of its own: equal names of trajectories are no equal
    # data.
    return [
        Trial(
            'soft_arm',
            scene,
            trajectory,
            map_scene,
            profile='full',
            **CONDITIONS[name],
            seed=seed + 10 * int(scene[1:]) + number,
        )
        for name in conditions()
        for map_scene, scene in MATCHING + ADDED + REMOVED
        for number, trajectory in enumerate(TRAJECTORIES[scene])
    ]


def pair(trial: Trial) -> tuple[str, str]:
    """(map, scene) of a trial."""
    return (trial.map_scene or trial.scene, trial.scene)
