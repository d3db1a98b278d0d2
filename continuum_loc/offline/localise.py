"""
The filter for a robot, as studies, tests and the command line make it.

What this module imports decides, with `replay`, what a replay gives, and nothing else does: the
simulator has no place here (see `source`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from continuum_loc.robot import load_robot, RobotDescription

if TYPE_CHECKING:
    from continuum_loc.estimator.settings import EstimatorSettings
    from continuum_loc.mapping.prior_map import PriorMap
    from continuum_loc.offline.replay import Filter
    from continuum_loc.offline.trials import Trial


def trial_settings(trial: Trial) -> EstimatorSettings:
    """Load the settings for the robot with sensors of the trial's fidelity, else the robot's."""
    from continuum_loc.estimator.settings import PRESETS_FOLDER, settings_of

    robot = load_robot(trial.robot).name
    special = f'{robot}_{trial.fidelity}'
    return settings_of(special if (PRESETS_FOLDER / f'{special}.yaml').is_file() else robot)


def make_filter(
    robot: RobotDescription, prior_map: PriorMap | None, settings: EstimatorSettings | None = None
) -> Filter:
    """Make the sliding-window filter, by default with the settings that come with the robot."""
    from continuum_loc.estimator import settings_of, SlidingWindowFilter

    return SlidingWindowFilter(robot, prior_map, settings or settings_of(robot.name))
