"""
The constants in which a robot may depart from its description: a vector theta, 0 as described.

They come in blocks of one kind and name. Each says how far it may be off by the description's
`tolerances`; what these say is exact has no block.

    mount  a ToF sensor's or tracker's: T_ring_sensor Exp(theta) [m, rad]
    range  a ToF sensor's offset [m] and scale
    gyro   a gyro's axes: the angular velocity is (I + theta) times what is read, rows first
    strain scale, twist [rad] and offsets [1/m] of what the strain sensor reads
    clock  of a board: true time less stamp [s]. ToF sensors and IMU of a ring share one
    delay  of a sensor beside its board's [s]
    base   T_map_base Exp(theta) at no insertion [m, rad]
    map    of the prior map about its middle [m, rad]
    length of the backbone, relative
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.robot import based, mounted, RobotDescription
import numpy as np

KINDS = ('mount', 'range', 'gyro', 'strain', 'clock', 'delay', 'base', 'map', 'length')
PARTS = {
    'mount': ('x', 'y', 'z', 'rx', 'ry', 'rz'),
    'range': ('offset', 'scale'),
    'gyro': tuple(f'{row}{column}' for row in 'xyz' for column in 'xyz'),
    'strain': ('scale', 'twist', 'offset_y', 'offset_z'),
    'clock': ('offset',),
    'delay': ('offset',),
    'base': ('x', 'y', 'z', 'rx', 'ry', 'rz'),
    'map': ('x', 'y', 'z', 'rx', 'ry', 'rz'),
    'length': ('scale',),
}


class Block(NamedTuple):
    """Constants of one kind and name, their place in theta, and 1 sigma of each."""

    kind: str
    name: str
    at: slice
    sigma: np.ndarray


class Parameters:
    """
    Blocks of a robot, those of the `kinds` asked for, but for sensors that are `exact`.

    size: P; sigma: (P,) 1 sigma beforehand; middle: (3,) that the map turns about [m].
    """

    def __init__(
        self,
        robot: RobotDescription,
        kinds: Sequence[str] = KINDS,
        middle: np.ndarray | None = None,
        exact: Collection[str] = (),
    ):
        self.robot, self._kinds, self._exact = robot, tuple(kinds), frozenset(exact)
        self.middle = np.zeros(3) if middle is None else np.asarray(middle, float)
        self.boards = {one.name: f'board {one.ring}' for one in (*robot.tof, *robot.imu)}
        self.boards |= {one.name: one.name for one in robot.trackers}
        if robot.strain is not None:
            self.boards['strain'] = 'strain'
        self.blocks: list[Block] = []
        self._places: dict[tuple[str, str], slice] = {}
        for kind, name, sigma in _possible(robot, self.boards):
            known = name in exact or (kind, name) in self._places
            if kind in kinds and not known and np.all(sigma > 0.0):
                at = slice(self.size, self.size + len(sigma))
                self.blocks.append(Block(kind, name, at, sigma))
                self._places[kind, name] = at

    @cached_property
    def clocks(self) -> np.ndarray:
        """Places in theta of the boards' clocks, of which differences alone can be told."""
        return np.array([one.at.start for one in self.blocks if one.kind == 'clock'], np.int64)

    @property
    def size(self) -> int:
        return self.blocks[-1].at.stop if self.blocks else 0

    @property
    def sigma(self) -> np.ndarray:
        return np.concatenate([block.sigma for block in self.blocks] or [np.empty(0)])

    @property
    def names(self) -> list[str]:
        """What each constant is called, as in `ring1_tof1 mount x`."""
        return [
            f'{block.name} {block.kind} {part}'.strip()
            for block in self.blocks
            for part in PARTS[block.kind]
        ]

    def columns(self, kind: str, names: Sequence[str]) -> np.ndarray:
        """(len(names), n) places in theta of the n constants of a kind; -1 where there is none."""
        out = np.full((len(names), len(PARTS[kind])), -1, np.int64)
        for row, name in enumerate(names):
            at = self._places.get((kind, self.boards.get(name, name) if kind == 'clock' else name))
            if at is not None:
                out[row] = np.arange(at.start, at.stop)
        return out

    def of(self, kind: str, name: str, theta: np.ndarray) -> np.ndarray | None:
        """Return one block of theta (P,); None where there is none."""
        at = self._places.get((kind, name))
        return None if at is None else theta[at]

    def at(self, theta: np.ndarray) -> Parameters:
        """Count the same constants from the robot as it is with theta (P,)."""
        return Parameters(self.applied(theta), self._kinds, self.middle, self._exact)

    def applied(self, theta: np.ndarray) -> RobotDescription:
        """Describe the robot as it is with theta (P,), but for the map."""
        robot = self.robot
        update = {
            'tof': tuple(self._tof(one, theta) for one in robot.tof),
            'imu': tuple(self._imu(one, theta) for one in robot.imu),
            'trackers': tuple(
                self._timed(self._mounted(one, theta), theta) for one in robot.trackers
            ),
            'strain': self._strain(theta),
        }
        base = self.of('base', '', theta)
        if base is not None:
            update['base'] = based(robot.base, robot.base.T_map_base @ lie.exp(base))
        length = self.of('length', '', theta)
        if length is not None:
            rest = (robot.backbone.rest_strain[0] * (1.0 + float(length[0])),)
            rest += robot.backbone.rest_strain[1:]
            update['backbone'] = robot.backbone.model_copy(update={'rest_strain': rest})
        return robot.model_copy(update=update)

    def lateness(self, name: str) -> np.ndarray:
        """(P,) by which true time less stamp of a sensor depends on the constants."""
        out = np.zeros(self.size)
        for kind in ('clock', 'delay'):
            columns = self.columns(kind, [name])[0]
            out[columns[columns >= 0]] = 1.0
        return out

    def centred(self, theta: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Choose of all steps (P,) that tell the same the one that leaves most clocks right."""
        if len(self.clocks):
            step[self.clocks] -= np.median((theta + step)[self.clocks])
        return step

    def T_map_moved(self, theta: np.ndarray) -> np.ndarray:
        """(4, 4) by which the prior map is to be moved."""
        moved = self.of('map', '', theta)
        if moved is None:
            return np.eye(4)
        middle = np.eye(4)
        middle[:3, 3] = self.middle
        return middle @ lie.exp(moved) @ lie.inverse(middle)

    def _mounted(self, sensor, theta):
        moved = self.of('mount', sensor.name, theta)
        if moved is None:
            return sensor
        T_ring_sensor = sensor.mount.T_ring_sensor @ lie.exp(moved)
        return sensor.model_copy(update={'mount': mounted(T_ring_sensor)})

    def _timed(self, sensor, theta):
        late = self.lateness(sensor.name) @ theta
        return sensor.model_copy(update={'clock': sensor.clock + float(late)}) if late else sensor

    def _tof(self, sensor, theta):
        ranged = self.of('range', sensor.name, theta)
        sensor = self._timed(self._mounted(sensor, theta), theta)
        if ranged is None:
            return sensor
        # What is left of the corrected reading is scale times distance plus offset.
        offset, scale = float(ranged[0]), 1.0 + float(ranged[1])
        return sensor.model_copy(
            update={
                'range_offset': sensor.range_offset + sensor.range_scale * offset,
                'range_scale': sensor.range_scale * scale,
            }
        )

    def _imu(self, sensor, theta):
        turned = self.of('gyro', sensor.name, theta)
        sensor = self._timed(sensor, theta)
        if turned is None:
            return sensor
        # omega = (I + theta) R axes^-1 (read - bias), in the ring's frame.
        R = sensor.mount.T_ring_sensor[:3, :3]
        ahead = np.linalg.inv(np.eye(3) + turned.reshape(3, 3))
        axes = np.array(sensor.gyro_axes) @ R.T @ ahead @ R
        return sensor.model_copy(update={'gyro_axes': tuple(map(tuple, axes.tolist()))})

    def _strain(self, theta):
        model, found = self.robot.strain, self.of('strain', 'strain', theta)
        if model is None:
            return None
        clock = self.of('clock', 'strain', theta)
        if clock is not None:
            model = model.model_copy(update={'clock': model.clock + float(clock[0])})
        if found is None:
            return model
        # What is left of the corrected bending z is gain times the true one plus offset.
        gain = (1.0 + found[0]) * np.exp(1j * found[1])
        before = model.scale * np.exp(1j * np.radians(model.twist_deg))
        offset = complex(*model.offset) + before * complex(*found[2:])
        whole = before * gain
        return model.model_copy(
            update={
                'scale': float(abs(whole)),
                'twist_deg': float(np.degrees(np.angle(whole))),
                'offset': (offset.real, offset.imag),
            }
        )


def _possible(robot: RobotDescription, boards: dict[str, str]):
    """Yield kind, name and sigmas of all that may be off, whether or not it is exact."""
    told = robot.tolerances
    mount = told.mount_sigma
    for tof in robot.tof:
        yield 'mount', tof.name, mount
        yield 'range', tof.name, np.array([told.range_offset, told.range_scale])
    for tracker in robot.trackers:
        yield 'mount', tracker.name, mount
    axes = np.full((3, 3), np.radians(told.gyro_axes_deg))
    np.fill_diagonal(axes, told.gyro_scale)
    for imu in robot.imu:
        yield 'gyro', imu.name, axes.ravel()
    if robot.strain is not None:
        twist = np.radians(told.strain_twist_deg)
        yield ('strain', 'strain', np.array([told.strain_scale, twist] + 2 * [told.strain_offset]))
    for name, board in boards.items():
        yield 'clock', board, np.array([told.clock])
        if board != name:
            yield 'delay', name, np.array([told.delay])
    if robot.base.mode == 'fixed':
        yield 'base', '', told.base_sigma
    if robot.tof:
        yield 'map', '', np.repeat([told.map_position, np.radians(told.map_rotation_deg)], 3)
    yield 'length', '', np.array([told.length])
