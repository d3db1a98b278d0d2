"""
The simulated world: a robot driven through a scene, its samples, and the truth.

    world = World(load_robot("engine"), load_scene("S0"), "t1")
    for sample in world.run(20.0):
        ...

Samples come in the order of their stamps. The same seed gives the same samples, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
import heapq
import logging
from pathlib import Path
from typing import Any, get_args, TYPE_CHECKING

from continuum_loc.errors import SettingsError
from continuum_loc.measurements import Measurement, NANOSECONDS, TruthSample
from continuum_loc.robot import RobotDescription, Sensor
from continuum_loc.simulator import sensors as models
from continuum_loc.simulator.carrier import BaseTeller, Carrier, carrier, JOINTS
from continuum_loc.simulator.forces import contact_forces, Push, push
from continuum_loc.simulator.model import (
    advance,
    build_model,
    carriage_damping,
    GRAVITY,
    NODE_PREFIX,
    settle,
)
from continuum_loc.simulator.motion import backbone, Motion, segment_strain, State
from continuum_loc.simulator.plant import (
    bundled_plants,
    load_plant,
    node_arclengths,
    PlantSettings,
)
from continuum_loc.simulator.trajectories import Drive, levelled, trajectory
import numpy as np

if TYPE_CHECKING:
    from continuum_loc.simulator.readout import Readout
    from continuum_loc.simulator.scene import Scene
    from continuum_loc.simulator.tof import TofSensorModel
    from continuum_loc.simulator.vl53l5cx_settings import Vl53l5cxSettings

TRUTH_RATE = 100.0
ENCODER_RATE = 50.0
ENCODER_SIGMA = 1e-4  # m, tendon displacement
START = NANOSECONDS  # stamp of the first sample

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Stream:
    """
    One kind of sensor, or one sensor: its rate [Hz] and how to sample it at (stamp, seconds).

    phase: when its first sample is taken [s].
    """

    rate: float
    sample: Callable[[int, float], Iterable[Any]]
    phase: float = 0.0


class World:
    """
    A robot, a scene and a trajectory; `run` simulates them from rest.

    plant: PlantSettings, a name or a YAML file; None takes the bundled plant of the robot's name.
    trajectory: a name of `trajectories.trajectory`, or a Drive.
    scene: None is empty space, without ToF frames.
    tof_settings: how ToF sensors of the fidelity `vl53l5cx` depart from ideal; None takes what
    public flights show.
    T_magnet_true: (4, 4), where the magnet sits in the frame where it should; None: there.
    faults: wrappers of `faults`, applied to the stream in order.
    carried: what carries the base, a name of `carrier.carrier` or a Carrier; None: it stands.
    pushes: forces from outside.
    """

    def __init__(
        self,
        robot: RobotDescription,
        scene: Scene | None,
        trajectory: str | Drive,
        *,
        plant: PlantSettings | str | Path | None = None,
        profile: str = 'live',
        tof_fidelity: str = 'paper',
        tof_settings: Vl53l5cxSettings | None = None,
        T_magnet_true: np.ndarray | None = None,
        seed: int = 0,
        faults: tuple = (),
        carried: Carrier | str | None = None,
        pushes: tuple[Push, ...] = (),
    ) -> None:
        self.robot, self.scene, self.seed, self.faults = robot, scene, seed, faults
        self.plant = plant if isinstance(plant, PlantSettings) else _plant(plant, robot)
        self.carried = carrier(carried, robot) if isinstance(carried, str) else carried
        if self.carried is not None and robot.name == 'engine' and isinstance(trajectory, str):
            trajectory = levelled(trajectory, robot, self.plant, self.carried.roll)
        self.trajectory = _resolve(trajectory, robot, self.plant)
        self.nodes_s = node_arclengths(robot, self.plant, self.plant.profile(profile).link_length)
        _check_fidelity(tof_fidelity)
        self.tof_fidelity, self.tof_settings = tof_fidelity, tof_settings
        self.T_magnet_true = T_magnet_true
        supported = self.trajectory.supported
        model = build_model(robot, self.plant, scene, profile, supported, self.carried)
        self.body = _Body(robot, self.plant, model, self.trajectory, self.carried)
        self.body.pushes = pushes, self.nodes_s
        self.motion = Motion()
        if scene is not None:
            from continuum_loc.simulator.placement import check_start

            check_start(robot, scene, self.nodes_s, *self.body.straight())

    def run(self, duration: float | None = None) -> Iterator[Measurement | TruthSample]:
        """
        Yield the samples of `duration` seconds (None: the trajectory's), by their stamps.

        Every call starts again from rest. Raises SettingsError for a duration that is none, and
        model.SimulationDiverged.
        """
        if duration is not None and not 0.0 < duration < np.inf:
            raise SettingsError(f'duration {duration} s: must be finite and greater than 0')
        stream = self._run(self.trajectory.duration if duration is None else duration)
        for fault in self.faults:
            stream = fault(stream)
        return stream

    def full_state(self, s: np.ndarray) -> np.ndarray:
        """(..., 4, 4) true T_map_backbone at arclengths s (...), at the sample yielded last."""
        return backbone(self.motion.pose(self._now), self.nodes_s, s)

    def _run(self, duration: float) -> Iterator[Measurement | TruthSample]:
        self.body.settle()
        self.motion = Motion()
        for state in self.body.resting_states():
            self.motion.append(state)
        streams = self._streams()
        for stamp, _, stream in heapq.merge(
            *(_instants(i, s, duration) for i, s in enumerate(streams))
        ):
            self._now = stamp / NANOSECONDS
            while not self.motion.covers(self._now):
                self.motion.append(self.body.step())
            yield from streams[stream].sample(START + stamp, self._now)

    def _streams(self) -> list[_Stream]:
        """Sensors in a fixed order, each with its own random stream."""
        robot, generators = self.robot, _generators(self.seed)
        streams = [_Stream(TRUTH_RATE, self._truth), self._encoder_stream(next(generators))]
        for present, make in (
            (robot.imu, self._imu_stream),
            (robot.strain, self._strain_stream),
            (robot.hall, self._hall_stream),
            (robot.trackers, self._tracker_stream),
        ):
            rng = next(generators)
            if present:
                streams.append(make(rng))
        rng = next(generators)
        if self.carried is not None and robot.base.mode == 'measured':
            # Its stream is drawn last, so that all others are as those of a base that stands.
            streams.append(self._base_stream(np.random.default_rng((self.seed, 1))))
        if robot.tof and self.scene and self.tof_fidelity == 'paper':
            streams.append(self._tof_stream(rng))
        elif robot.tof and self.scene:
            streams.extend(self._real_tof_streams(rng))
        return streams

    def _truth(self, stamp: int, time: float) -> list[TruthSample]:
        rings = np.searchsorted(self.nodes_s, self.robot.ring_arclengths - 1e-6)
        return [TruthSample(stamp, self.motion.pose(time, np.concatenate([[0], rings])))]

    def _base_stream(self, rng: np.random.Generator) -> _Stream:
        told = self.robot.base.measurement
        model = BaseTeller(self.carried.told, told.frame, told.rate, rng)

        def sample(stamp: int, time: float) -> list:
            T_map_base = self.motion.pose(time, np.array([0]))[0]
            travel, _, _ = self.motion.encoders(time)
            T_map_base[:3, 3] -= travel * T_map_base[:3, 0]
            return model.measure(stamp, time, T_map_base)

        return _Stream(told.rate, sample)

    def _encoder_stream(self, rng: np.random.Generator) -> _Stream:
        moves = self.robot.base.insertion.mode == 'measured'
        model = models.Encoders(
            self.plant.tendon_names,
            self.body.straight_length,
            ENCODER_SIGMA,
            self.robot.base.insertion.sigma if moves else None,
            rng,
        )
        return _Stream(
            ENCODER_RATE, lambda stamp, time: [model.measure(stamp, *self.motion.encoders(time))]
        )

    def _imu_stream(self, rng: np.random.Generator) -> _Stream:
        model = models.ImuSensors(self.robot.imu_model, self.robot.imu, GRAVITY, rng)
        nodes, mounts = self._mounts(self.robot.imu)

        def sample(stamp: int, time: float) -> list:
            return model.measure(
                stamp, *self.motion.kinematics(time, self.motion.frames(nodes, mounts))
            )

        return _Stream(self.robot.imu_model.rate, sample)

    def _strain_stream(self, rng: np.random.Generator) -> _Stream:
        model = models.StrainSensor(
            self.robot.strain, self.robot.strain_stations, self.nodes_s, rng
        )

        def sample(stamp: int, time: float) -> list:
            return [model.measure(stamp, segment_strain(self.motion.pose(time), self.nodes_s))]

        return _Stream(self.robot.strain.rate, sample)

    def _hall_stream(self, rng: np.random.Generator) -> _Stream:
        magnet = self.robot.magnet
        model = models.HallSensors(
            self.robot.hall_model, self.robot.hall, magnet, self.plant.earth_field, rng
        )
        pose = self._posed(self.robot.hall)

        def sample(stamp: int, time: float) -> list:
            nodes = self.motion.pose(time)
            T_map_magnet = backbone(nodes, self.nodes_s, magnet.s) if magnet else nodes[0]
            if self.T_magnet_true is not None:
                T_map_magnet = T_map_magnet @ self.T_magnet_true
            return model.measure(stamp, pose(time), T_map_magnet)

        return _Stream(self.robot.hall_model.rate, sample)

    def _tracker_stream(self, rng: np.random.Generator) -> _Stream:
        model = models.Trackers(self.robot.trackers, rng)
        pose = self._posed(self.robot.trackers)
        return _Stream(model.model.rate, lambda stamp, time: model.measure(stamp, pose(time)))

    def _tof_stream(self, rng: np.random.Generator) -> _Stream:
        from continuum_loc.simulator.raycast import RayCaster
        from continuum_loc.simulator.tof import TofSensorModel

        model = TofSensorModel(self.robot.tof_model, RayCaster(self.scene), self.tof_fidelity, rng)
        names = [sensor.name for sensor in self.robot.tof]
        pose = self._posed(self.robot.tof)

        def sample(stamp: int, time: float) -> list:
            body = self._capsules(self.motion.pose(time))
            return model.measure(pose(time), names, stamp, body_capsules=body)

        return _Stream(self.robot.tof_model.rate, sample)

    def _real_tof_streams(self, rng: np.random.Generator) -> Iterator[_Stream]:
        """Yield one stream per sensor: real ones are out of step, and each has its own rate."""
        from continuum_loc.simulator.raycast import RayCaster
        from continuum_loc.simulator.readout import Readout, ReadoutSettings
        from continuum_loc.simulator.tof import TofSensorModel

        caster, rate = RayCaster(self.scene), self.robot.tof_model.rate
        readout = ReadoutSettings()
        for sensor in self.robot.tof:
            own = np.random.default_rng(rng.integers(2**63))
            model = TofSensorModel(
                self.robot.tof_model, caster, self.tof_fidelity, own, self.tof_settings
            )
            phase = own.uniform(0.0, 1.0 / rate)
            true_rate = rate * (1.0 + readout.rate_tolerance * own.standard_normal())
            sample = self._read_out(model, sensor, Readout(readout, own))
            yield _Stream(true_rate, sample, phase)

    def _read_out(
        self, model: TofSensorModel, sensor: Sensor, readout: Readout
    ) -> Callable[[int, float], Iterable[Any]]:
        """Make the sampling of one ToF sensor: of an exposure comes what is read out then."""
        (node,), mount = self._mounts((sensor,))

        def sample(stamp: int, time: float) -> Iterator[Any]:
            nodes = self.motion.pose(time)
            frames = model.measure(
                nodes[node] @ mount, [sensor.name], stamp, self._capsules(nodes)
            )
            return readout.take(frames[0])

        return sample

    def _capsules(self, T_map_node: np.ndarray) -> np.ndarray:
        """(M, 7) ends and radius of the body's pieces, as `raycast.cast_capsules` takes them."""
        points = T_map_node[:, :3, 3]
        return np.column_stack(
            [points[:-1], points[1:], np.full(len(points) - 1, self.robot.radius)]
        )

    def _posed(self, sensors: tuple[Sensor, ...]) -> Callable[[float], np.ndarray]:
        """Time [s] -> (F, 4, 4) true poses T_map_sensor."""
        nodes, mounts = self._mounts(sensors)
        return lambda time: self.motion.pose(time, nodes) @ mounts

    def _mounts(self, sensors: tuple[Sensor, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Node of each sensor's ring (F,), and T_ring_sensor (F, 4, 4)."""
        s = np.array([self.robot.sensor_arclength(sensor.name) for sensor in sensors])
        mounts = np.stack([sensor.mount.T_ring_sensor for sensor in sensors])
        return np.searchsorted(self.nodes_s, s - 1e-6), mounts


class _Body:
    """MuJoCo's side: drives in, states out."""

    def __init__(
        self,
        robot: RobotDescription,
        plant: PlantSettings,
        model: Any,
        path: Drive,
        carried: Carrier | None = None,
    ) -> None:
        import mujoco

        self._mujoco, self.model, self.data, self.path = mujoco, model, mujoco.MjData(model), path
        self._nodes = np.array(
            [i for i in range(model.nbody) if model.body(i).name.startswith(NODE_PREFIX)]
        )
        self._slides = robot.base.insertion.mode != 'fixed'
        self._carried = carried
        self._driven = self._slides + (len(JOINTS) if carried else 0)  # joints of base and carrier
        # [s], cancels the drag of the drive's damping.
        self._lead = carriage_damping(plant) / plant.carriage_stiffness
        mujoco.mj_forward(model, self.data)
        self.straight_length = self.data.ten_length.copy()
        self._steps = 0
        self.pushes: tuple[tuple[Push, ...], np.ndarray] = (), np.empty(0)

    def straight(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 3) of the nodes of the straight robot, and how deep each touches (N,) [m]."""
        mujoco, model, data = self._mujoco, self.model, self.data
        self._start_straight()
        mujoco.mj_forward(model, data)
        depth = np.zeros(model.nbody)
        for bodies in model.geom_bodyid[data.contact.geom].T:
            np.maximum.at(depth, bodies, -data.contact.dist)
        return data.xpos[self._nodes].copy(), depth[self._nodes]

    def _start_straight(self) -> None:
        self._mujoco.mj_resetData(self.model, self.data)
        self._command(0.0)
        self.data.qpos[: self._driven] = self.data.ctrl[: self._driven]

    def settle(self) -> None:
        """Bring the robot from straight to rest under the trajectory's first command."""
        self._start_straight()
        settle(self.model, self.data)
        self.data.time = 0.0
        self._steps = 0

    def resting_states(self) -> list[State]:
        """Return the states at -1, 0 and +1 steps: motion is defined from time 0 on."""
        first = self.step()
        before = State(
            -self.model.opt.timestep,
            first.T_map_node,
            first.insertion,
            first.tendon_length,
            first.tension,
        )
        return [before, first, self.step()]

    def step(self) -> State:
        """
        Return the state at the next step's beginning; then set the drives and take the step.

        MuJoCo's derived quantities after a step still belong to its beginning, so no extra
        kinematics are needed.
        """
        time = self._steps * self.model.opt.timestep
        self._command(time)
        advance(self.model, self.data)
        self._steps += 1
        return self._state(time)

    def contact_forces(self) -> np.ndarray:
        """(N + 1, 3) forces [N] in the map by which contacts push the nodes at present."""
        return contact_forces(self.model, self.data, self._nodes)

    def penetration(self) -> float:
        """Depth of the deepest contact at present [m], 0 where nothing touches."""
        return max(0.0, -float(self.data.contact.dist.min())) if self.data.ncon else 0.0

    def _command(self, time: float) -> None:
        command = self.path.command(time)
        drive = [command.insertion + self._lead * command.insertion_rate] if self._slides else []
        if self._carried is not None:
            value, rate = self._carried.command(time)
            drive = [*(value + self._lead * rate), *drive]
        self.data.ctrl[:] = np.append(drive, command.tension)
        if self.pushes[0]:
            push(self.data, self._nodes, self.pushes[1], self.pushes[0], time)

    def _state(self, time: float) -> State:
        data = self.data
        T = np.zeros((len(self._nodes), 4, 4))
        T[:, :3, :3] = data.xmat[self._nodes].reshape(-1, 3, 3)
        T[:, :3, 3] = data.xpos[self._nodes]
        T[:, 3, 3] = 1.0
        driven = self._driven
        tendons = data.ctrl[driven:]
        return State(time, T, self._insertion(T), data.ten_length.copy(), tendons.copy())

    def _insertion(self, T_map_node: np.ndarray) -> float:
        """Travel of the base along its own axis [m], from the same kinematics as the poses."""
        if self._carried is not None:
            mount = self.data.body('carrier')
            axis = mount.xmat.reshape(3, 3)[:, 0]
            return float((T_map_node[0, :3, 3] - mount.xpos) @ axis)
        base = self.model.body('carriage')
        R = np.zeros(9)
        self._mujoco.mju_quat2Mat(R, base.quat)
        return float((T_map_node[0, :3, 3] - base.pos) @ R.reshape(3, 3)[:, 0])


def _check_fidelity(name: str) -> None:
    from continuum_loc.simulator.tof import Fidelity

    if name not in get_args(Fidelity):
        raise SettingsError(f"no ToF fidelity '{name}': give {' or '.join(get_args(Fidelity))}")


def _plant(name: str | Path | None, robot: RobotDescription) -> PlantSettings:
    if name is None and robot.name not in bundled_plants():
        raise SettingsError(
            f"robot '{robot.name}' has no plant (stiffness, mass, tendons) among the bundled "
            f'ones, {", ".join(bundled_plants())}: give your own (--plant my_plant.yaml)'
        )
    return load_plant(name or robot.name)


def _resolve(path: str | Drive, robot: RobotDescription, plant: PlantSettings) -> Drive:
    path = trajectory(path, robot, plant) if isinstance(path, str) else path
    tendons = len(plant.tendon_names)
    if path.tensions.shape[1] != tendons:
        raise SettingsError(
            f"trajectory '{path.name}' drives {path.tensions.shape[1]} tendons, "
            f'the plant has {tendons}'
        )
    least, most = robot.base.insertion.range
    if most - least > robot.length:
        _log.warning(
            "robot '%s': its base travels %g m, farther than its length of %g m; the drive behind "
            'the base touches nothing in the simulation',
            robot.name,
            most - least,
            robot.length,
        )
    if path.insertion.min() < least - 1e-9 or path.insertion.max() > most + 1e-9:
        raise SettingsError(
            f"trajectory '{path.name}' inserts {path.insertion.min()} to "
            f"{path.insertion.max()} m; robot '{robot.name}' can travel {least} to {most} m"
        )
    return path


def _generators(seed: int) -> Iterator[np.random.Generator]:
    """One independent random stream after another."""
    return (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(16))


def _instants(number: int, stream: _Stream, duration: float) -> Iterator[tuple[int, int, int]]:
    """(stamp from the start [ns], priority, number) at phase + k / rate, before `duration`."""
    count = int(np.ceil((duration - stream.phase) * stream.rate - 1e-9))
    first = round(stream.phase * NANOSECONDS)
    return ((first + round(k * NANOSECONDS / stream.rate), number, number) for k in range(count))
