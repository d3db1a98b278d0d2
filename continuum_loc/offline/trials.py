"""
One trial: a robot, simulated in a scene along a trajectory, and its recording.

Studies, tests and the command line all build their trials here. What this module imports decides
what a recording holds, and nothing else does: the filter has no place here (see `source`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import hashlib
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from continuum_loc import lie
from continuum_loc.errors import SettingsError
from continuum_loc.measurements import Measurement, TruthSample
from continuum_loc.robot import based, load_robot, RobotDescription
import numpy as np

if TYPE_CHECKING:
    from continuum_loc.simulator.departures import Departures
    from continuum_loc.simulator.scene import Scene
    from continuum_loc.simulator.world import World

# What a disturbed trial gets, 1 sigma per axis and sensor, but for the offset, which all ToF
# stamps share.
MOUNTING_ERROR = (0.002, 1.0)  # m, deg
GYRO_BIAS = 0.01  # rad/s
TOF_CLOCK_OFFSET = 0.010  # s
NOWHERE = 'none'  # a scene of empty space, without ToF frames

# What a trial's description says of the base, and what a trial's carrier tells of it.
BASES: dict[str, dict[str, Any]] = {
    'fixed': {'mode': 'fixed'},
    'measured': {
        'mode': 'measured',
        'sigma_position': 0.001,
        'sigma_rotation_deg': 0.2,
        'measurement': {
            'sigma_position': 0.0002,
            'sigma_rotation_deg': 0.02,
            'latency': 0.010,
        },
    },
    'untold latency': {
        'mode': 'measured',
        'sigma_position': 0.001,
        'sigma_rotation_deg': 0.2,
        'measurement': {'sigma_position': 0.0002, 'sigma_rotation_deg': 0.02},
    },
    'odometry': {
        'mode': 'measured',
        'measurement': {
            'frame': 'odom',
            'drift': 0.05,
            'sigma_position': 0.0002,
            'sigma_rotation_deg': 0.02,
        },
    },
    'free': {'mode': 'free'},
}
TOLD = {'arm': {'latency': 0.010}, 'odometry': {'drift': 0.05}}


@dataclass(frozen=True)
class Trial:
    """
    What decides a simulated trial.

    robot: a bundled name or a YAML file. scene, map_scene: scene names or mesh files; the prior
    map is that of `map_scene` (default: the scene's own). profile: `live` or `full`. fidelity:
    `paper` or `vl53l5cx`. plant: a bundled name or a YAML file; None for the robot's own.
    disturbed: mounting errors, gyro biases and a clock offset that the estimator does not know.
    world: `ideal`, or a file of true departures (`simulator.departures`), which also says what ToF
    sensors it has; the prior map departs with it.
    carried: what carries the base, of the robot's carriers; empty: it stands. told: how that tells
    where it is, of TOLD; base: what the description says of it, of BASES; empty: as it is.
    drawn_base: the base sits where a draw from the description's own spread puts it, not where
    the description says: what a covariance that counts with this spread has to be judged by.
    duration: seconds; None for the trajectory's own.
    """

    robot: str = 'engine'
    scene: str = 'S0'
    trajectory: str = 't1'
    map_scene: str | None = None
    profile: str = 'live'
    fidelity: str = 'paper'
    disturbed: bool = False
    drawn_base: bool = False
    seed: int = 0
    duration: float | None = None
    plant: str | None = None
    world: str = 'ideal'
    carried: str = ''
    told: str = 'arm'
    base: str = ''

    def __post_init__(self) -> None:
        object.__setattr__(self, 'fidelity', self.departures.fidelity(self.fidelity))

    @property
    def departures(self) -> Departures:
        """In what the trial's world departs from the files that the estimator reads."""
        from continuum_loc.simulator.departures import load_departures

        return load_departures(self.world)

    @property
    def recording(self) -> str:
        """Name of what is simulated; trials that differ in the map alone share it."""
        length = '' if self.duration is None else f'-{self.duration:g}s'
        return (
            '-'.join(
                [
                    Path(self.robot).stem,
                    Path(self.scene).stem,
                    self.trajectory,
                    self.fidelity,
                    self.profile,
                ]
                + ['disturbed'] * self.disturbed
                + ['drawn'] * self.drawn_base
                + [f'world_{_world_name(self.world)}'] * (self.world != 'ideal')
                + [Path(self.plant or '').stem] * bool(self.plant)
                + [f'{Path(self.carried).stem}_{self.told}'] * bool(self.carried)
            )
            + f'-{self.seed}{length}'
        )

    @property
    def name(self) -> str:
        """Name the trial, uniquely among trials."""
        base = f'-base_{self.base}'.replace(' ', '_') * bool(self.base)
        return f'{Path(self.map_scene or self.scene).stem}-map-{self.recording}{base}'

    @property
    def description(self) -> RobotDescription:
        """What the estimator is told of the robot."""
        return (
            with_base(load_robot(self.robot), self.base) if self.base else load_robot(self.robot)
        )


def _world_name(world: str) -> str:
    """Name a world in a folder's name; a file of one's own by what it says."""
    name, _, parts = world.partition(':')
    own = Path(name).suffix in ('.yaml', '.yml')
    said = f'_{hashlib.sha256(Path(name).read_bytes()).hexdigest()[:8]}' if own else ''
    return f'{Path(name).stem}{said}{"_" * bool(parts)}{parts.replace("+", "_")}'


def world(trial: Trial, faults: tuple = ()) -> World:
    """Make the simulated world of a trial, at rest."""
    from continuum_loc.simulator.scenes import load_scene
    from continuum_loc.simulator.world import World

    robot = load_robot(trial.robot)
    if trial.carried:
        return _carried(trial, robot, faults)
    if trial.drawn_base:
        robot = _base_drawn(robot, trial.seed)
    if trial.disturbed:
        robot, faults = _disturbed(robot, trial.seed, faults)
    scene = load_scene(trial.scene) if robot.tof and trial.scene != NOWHERE else None
    if trial.world != 'ideal':
        return _true_world(robot, scene, trial, faults)
    return World(
        robot,
        scene,
        trial.trajectory,
        plant=trial.plant,
        profile=trial.profile,
        tof_fidelity=trial.fidelity,
        seed=trial.seed,
        faults=faults,
    )


def with_base(robot: RobotDescription, name: str) -> RobotDescription:
    """Make of a robot one of whose base the description says what BASES has under a name."""
    base = type(robot.base).model_validate(robot.base.model_dump() | BASES[name])
    return robot.model_copy(update={'base': base})


def _carried(trial: Trial, robot: RobotDescription, faults: tuple) -> World:
    """
    Make the world of a trial on a base that is carried, and tells where it is.

    Raises SettingsError for what cannot be had together, or is unknown.
    """
    from continuum_loc.simulator.carrier import carrier, Told
    from continuum_loc.simulator.scenes import load_scene
    from continuum_loc.simulator.world import World

    if trial.told not in TOLD:
        raise SettingsError(f"no '{trial.told}' tells of a base; give one of {', '.join(TOLD)}")
    if trial.disturbed or trial.drawn_base or trial.world != 'ideal':
        raise SettingsError('a base is carried in the ideal world alone')
    if robot.base.mode != 'measured':
        robot = with_base(robot, 'odometry' if trial.told == 'odometry' else 'measured')
    own = Path(trial.carried).suffix in ('.yaml', '.yml')  # which says itself what is told
    return World(
        robot,
        load_scene(trial.scene) if robot.tof and trial.scene != NOWHERE else None,
        trial.trajectory,
        plant=trial.plant,
        profile=trial.profile,
        tof_fidelity=trial.fidelity,
        seed=trial.seed,
        faults=faults,
        carried=carrier(trial.carried, robot, None if own else Told(**TOLD[trial.told])),
    )


def _true_world(
    robot: RobotDescription, scene: Scene | None, trial: Trial, faults: tuple
) -> World:
    """
    Make the world of a trial as it truly is, of a robot as it is described.

    The drives pull as the nominal plant has it: what the true one does with that is its own. The
    estimator gets the nominal robot and its own settings, and nothing of what is drawn here.
    """
    from continuum_loc.simulator import departures as true
    from continuum_loc.simulator.plant import load_plant
    from continuum_loc.simulator.trajectories import trajectory as path_of
    from continuum_loc.simulator.world import World

    departures, fidelity, seed = trial.departures, trial.fidelity, trial.seed
    nominal = load_plant(trial.plant or robot.name)
    return World(
        true.true_robot(robot, departures, seed),
        scene,
        path_of(trial.trajectory, robot, nominal),
        plant=true.true_plant(nominal, departures, seed),
        profile=trial.profile,
        tof_fidelity=fidelity,
        tof_settings=true.tof_settings(departures, fidelity),
        T_magnet_true=true.magnet_error(departures, seed),
        seed=seed,
        faults=(*faults, *true.sensor_departures(robot, departures, fidelity, seed)),
    )


def _base_drawn(robot: RobotDescription, seed: int) -> RobotDescription:
    """Move the robot's base by a draw from the spread that its description states."""
    base = robot.base
    T_map_base = base.T_map_base @ lie.exp(base.sigma * np.random.default_rng(seed).normal(size=6))
    return robot.model_copy(update={'base': based(base, T_map_base)})


def _disturbed(
    robot: RobotDescription, seed: int, faults: tuple
) -> tuple[RobotDescription, tuple]:
    """Make the robot as it truly is, and its clocks."""
    from continuum_loc.simulator.faults import ClockOffset, miscalibrated

    biased = robot.model_copy(
        update={'imu_model': robot.imu_model.model_copy(update={'gyro_bias_sigma': GYRO_BIAS})}
    )
    clock = ClockOffset(
        sensors=tuple(sensor.name for sensor in robot.tof), offset=TOF_CLOCK_OFFSET
    )
    return miscalibrated(biased, *MOUNTING_ERROR, seed=seed), (*faults, clock)


def simulate(trial: Trial, faults: tuple = ()) -> Iterator[Measurement | TruthSample]:
    """Yield the samples of a trial, truth among them, in the order of their stamps."""
    return world(trial, faults).run(trial.duration)


def measured(trial: Trial) -> list[Measurement]:
    """List what the sensors of a trial measure: its samples without the truth."""
    return [sample for sample in simulate(trial) if not isinstance(sample, TruthSample)]


def write_bag(path: Path, samples: Iterator[Measurement | TruthSample]) -> dict[str, int]:
    """
    Record samples into a new bag folder; how many of each topic.

    Where the samples end in an error, no bag is left: half of one would pass for the whole.
    """
    from msg_tools.bag import BagWriter
    from msg_tools.topics import topic_of

    counts: dict[str, int] = {}
    bag = BagWriter(path)
    try:
        with bag:
            for sample in samples:
                topic = topic_of(sample)
                bag.write(topic, sample)
                counts[topic] = counts.get(topic, 0) + 1
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise
    return counts
