"""
The robot description: geometry, sensors and datasheet noise, from one validated YAML file.

It serves the simulator and the estimator alike. What only the true plant knows (its stiffness,
mass, friction, faults) lives in the simulator's plant files, so that the estimator cannot peek;
what is believed of them is the block `actuation`.

Frames: body x is the backbone's tangent. The frame of a ring is the backbone frame at the ring's
arclength; a sensor's pose on its ring is `T_ring_sensor`. A ToF sensor's optical axis is its x.
"""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from pathlib import Path
from typing import Literal

from continuum_loc.actuation import Actuation
from continuum_loc.settings import load_bundled, Name, Settings
import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

ROBOTS_FOLDER = Path(__file__).parent / 'robots'

# What no robot in metres exceeds, and what nearly every one in millimetres does.
LONGEST, THICKEST = 100.0, 1.0  # m
LONGEST_ARM = 0.5  # m: from a ring to a sensor on a stalk, beside ten radii of the body

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]


class Mount(Settings):
    """
    Where a sensor sits on its ring.

    Either `azimuth_deg` and `radius` (radial, looking outward), or `xyz` (m) and `rpy_deg`
    (fixed-axis roll, pitch, yaw) in the ring's frame.
    """

    azimuth_deg: float | None = Field(
        None, description='angle about the tangent x, from body y towards z [deg]'
    )
    radius: float | None = Field(None, ge=0.0, description='distance from the backbone [m]')
    xyz: Vector3 | None = Field(None, description='position in the ring frame [m]')
    rpy_deg: Vector3 | None = Field(None, description='fixed-axis roll, pitch, yaw [deg]')

    @model_validator(mode='after')
    def _one_form(self) -> Mount:
        radial = (self.azimuth_deg is not None, self.radius is not None)
        explicit = (self.xyz is not None, self.rpy_deg is not None)
        if not (all(radial) and not any(explicit)) and not (all(explicit) and not any(radial)):
            raise ValueError('give either both azimuth_deg and radius, or both xyz and rpy_deg')
        return self

    @cached_property
    def T_ring_sensor(self) -> np.ndarray:
        """(4, 4) from the sensor frame to the ring frame; shared, so not to be written to."""
        T_ring_sensor = np.eye(4)
        if self.xyz is not None:
            T_ring_sensor[:3, :3] = Rotation.from_euler(
                'xyz', self.rpy_deg, degrees=True
            ).as_matrix()
            T_ring_sensor[:3, 3] = self.xyz
            return T_ring_sensor
        angle = np.radians(self.azimuth_deg)
        outward = np.array([0.0, np.cos(angle), np.sin(angle)])
        # Sensor x looks outward and sensor y lies along the tangent, so rows of zones run along
        # the robot.
        tangent = np.array([1.0, 0.0, 0.0])
        T_ring_sensor[:3, :3] = np.column_stack([outward, tangent, np.cross(outward, tangent)])
        T_ring_sensor[:3, 3] = self.radius * outward
        return T_ring_sensor


def mounted(T_ring_sensor: np.ndarray) -> Mount:
    """Describe a mount by its pose (4, 4)."""
    return Mount(xyz=tuple(T_ring_sensor[:3, 3].tolist()), rpy_deg=_rpy_deg(T_ring_sensor))


def _six(position: float, rotation_deg: float) -> np.ndarray:
    """(6,) standard deviations of a pose [m, rad], of one of each axis [m, deg]."""
    return np.repeat([position, np.radians(rotation_deg)], 3)


def _rpy_deg(T: np.ndarray) -> Vector3:
    rpy_deg = Rotation.from_matrix(T[:3, :3]).as_euler('xyz', degrees=True)
    return tuple(rpy_deg.tolist())


class Sensor(Settings):
    """A sensor's name (its `frame_id`), its ring and its mount there."""

    name: Name
    ring: str
    mount: Mount = Mount(xyz=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0))
    clock: float = Field(0.0, description='true time less stamp [s]')


class TofSensor(Sensor):
    """A ToF sensor: what it reads is `range_scale` times the distance, plus `range_offset`."""

    range_offset: float = Field(0.0, description='reading of a distance of none [m]')
    range_scale: float = Field(1.0, gt=0.5, lt=2.0, description='reading over distance')


class ImuSensor(Sensor):
    """An IMU: its gyro reads `gyro_axes` times the angular velocity, plus `gyro_bias`."""

    gyro_axes: tuple[Vector3, Vector3, Vector3] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description='rows: the axes as they are, times their scales',
    )
    gyro_bias: Vector3 = Field((0.0, 0.0, 0.0), description='reading at rest [rad/s]')

    @field_validator('gyro_axes')
    @classmethod
    def _usable(cls, value: tuple) -> tuple:
        if not 0.1 < float(np.linalg.det(np.array(value))) < 10.0:
            raise ValueError('must be three right-handed axes of about unit length')
        return value


class Ring(Settings):
    """A sensor disc at unstretched arclength `s` from the base."""

    name: Name
    s: float = Field(ge=0.0, description='arclength from the base [m]')


class Insertion(Settings):
    """The base's travel along its own x axis."""

    mode: Literal['fixed', 'measured', 'unknown'] = Field(
        'fixed',
        description='fixed at 0; measured by the `insertion` joint state; '
        'or unknown within `range`',
    )
    range: tuple[float, float] = Field(  # noqa: A003  (a name in robot descriptions)
        (0.0, 0.0), description='least and greatest travel [m]'
    )
    sigma: float = Field(0.0005, gt=0.0, description='standard deviation of the encoder [m]')

    @model_validator(mode='after')
    def _consistent(self) -> Insertion:
        least, most = self.range
        if least > most:
            raise ValueError(f'range: the least travel comes first, got [{least}, {most}]')
        if self.mode == 'fixed' and least != most:
            raise ValueError(
                f'range [{least}, {most}] with mode fixed: a base that travels is '
                'measured or unknown; leave the range out for one that does not'
            )
        return self


class BaseMeasurement(Settings):
    """
    What tells where a carried base is: an arm's kinematics, a vehicle's odometry, a tracker.

    Its samples are poses of the base at zero insertion in `frame`. Their error is white noise of
    each sample and a part that lasts: that of the arm's kinematics, or the drift of odometry.
    """

    frame: Name = Field('map', description='frame that the poses are given in')
    rate: float = Field(100.0, gt=0.0, description='samples per second')
    sigma_position: float = Field(
        0.0005, gt=0.0, description='white noise of a sample, where the message states none [m]'
    )
    sigma_rotation_deg: float = Field(
        0.05, gt=0.0, description='white noise of a sample, where the message states none [deg]'
    )
    lasting: float = Field(
        5.0,
        gt=0.0,
        description="time over which the lasting part of the error, of the base's sigma_position "
        'and sigma_rotation_deg, becomes another one [s]',
    )
    drift: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description='share of its way by which `frame` drifts in `map`; with any, the lasting '
        'part grows without bound',
    )
    latency: float = Field(
        0.0, description='by how much a stamp is later than the instant of its pose [s]'
    )


class Base(Settings):
    """
    Pose of the base in `map` at zero insertion, and how well it is known.

    A `fixed` base stays there. A `measured` one is carried, and its pose told; one in another
    frame than `map` begins there. A `free` one is carried or lies anywhere, and nothing but the
    robot's own sensors tells where: it begins there, within the sigmas.
    """

    mode: Literal['fixed', 'measured', 'free'] = Field(
        'fixed', description='whether the base stays, is carried and measured, or is anywhere'
    )
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    sigma_position: float = Field(
        0.0005, gt=0.0, description='standard deviation of the base position [m]'
    )
    sigma_rotation_deg: float = Field(
        0.1, gt=0.0, description='standard deviation of the base rotation [deg]'
    )
    insertion: Insertion = Insertion()
    measurement: BaseMeasurement = BaseMeasurement()
    region: tuple[float, float] = Field(
        (0.0, 0.0),
        description='how far from there a free base may begin [m, deg]; with (0, 0) it begins '
        'there, and 180 deg and a way that is longer than the map leave it anywhere in it',
    )
    speed: tuple[float, float] = Field(
        (0.3, 0.5), description='how fast a carried base moves and turns, 1 sigma [m/s, rad/s]'
    )
    acceleration: tuple[float, float] = Field(
        (0.01, 0.03),
        description='white noise on the acceleration of a carried base [m^2/s^3, rad^2/s^3]',
    )

    @field_validator('region')
    @classmethod
    def _not_negative(cls, value: tuple[float, float]) -> tuple[float, float]:
        if min(value) < 0.0:
            raise ValueError('both must be 0 or greater')
        return value

    @field_validator('speed', 'acceleration')
    @classmethod
    def _above_zero(cls, value: tuple[float, float]) -> tuple[float, float]:
        if min(value) <= 0.0:
            raise ValueError('both must be greater than 0')
        return value

    @property
    def sigma(self) -> np.ndarray:
        """(6,) of its pose [m, rad]."""
        return _six(self.sigma_position, self.sigma_rotation_deg)

    @cached_property
    def T_map_base(self) -> np.ndarray:
        """(4, 4) base pose at zero insertion."""
        T_map_base = np.eye(4)
        T_map_base[:3, :3] = Rotation.from_euler('xyz', self.rpy_deg, degrees=True).as_matrix()
        T_map_base[:3, 3] = self.xyz
        return T_map_base


def based(base: Base, T_map_base: np.ndarray) -> Base:
    """Move a base to a pose (4, 4) at zero insertion."""
    moved = {'xyz': tuple(T_map_base[:3, 3].tolist()), 'rpy_deg': _rpy_deg(T_map_base)}
    return Base(**{**base.model_dump(), **moved})


class Backbone(Settings):
    """
    The shape prior: rest strain [nu; omega] and how far each component departs from it (1 sigma).

    Small sigmas on extension and shear make a Kirchhoff rod, a loose first component an extensible
    arm, a small fourth component a twist-free tendon robot.
    """

    rest_strain: Vector6 = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rest_strain_sigma: Vector6 = (0.002, 0.002, 0.002, 0.02, 4.0, 4.0)
    module_ends: tuple[float, ...] = Field(
        (), description='arclengths at which a module ends, so that strain may step there [m]'
    )

    @field_validator('module_ends')
    @classmethod
    def _in_order(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if any(s <= 0.0 for s in value) or list(value) != sorted(set(value)):
            raise ValueError('must increase from above 0; the ends of the body are no module ends')
        return value

    @field_validator('rest_strain_sigma')
    @classmethod
    def _positive(cls, value: Vector6) -> Vector6:
        if min(value) <= 0.0:
            raise ValueError('every component must be greater than 0')
        return value


class TofModel(Settings):
    """Datasheet of a multizone ToF sensor (VL53L5CX unless changed)."""

    rows: int = Field(8, ge=1)
    columns: int = Field(8, ge=1)
    fov_deg: float = Field(45.0, gt=0.0, lt=170.0, description='full square field of view [deg]')
    grid: Literal['uniform_tangent', 'uniform_angle'] = 'uniform_tangent'
    flip_rows: bool = Field(False, description='the lens of a mounted VL53L5CX flips both')
    flip_columns: bool = False
    convention: Literal['range', 'perpendicular'] = Field(
        'range',
        description='what the raw distance means: along the ray, or along the optical axis',
    )
    rate: float = Field(15.0, gt=0.0, description='frames per second')
    min_range: float = Field(0.025, ge=0.0, description='closer returns are invalid [m]')
    max_range: float = Field(4.0, gt=0.0, description='farther returns are none [m]')
    # Table I of the paper: sigma = coefficient(d) * d, the coefficient interpolated linearly.
    noise_distance: tuple[float, ...] = (0.025, 0.6, 1.2)
    noise_coefficient: tuple[float, ...] = (0.014, 0.012, 0.006)

    @model_validator(mode='after')
    def _consistent(self) -> TofModel:
        if self.min_range >= self.max_range:
            raise ValueError(
                f'min_range {self.min_range} m must be below max_range {self.max_range} m'
            )
        distance, coefficient = self.noise_distance, self.noise_coefficient
        if not distance or len(distance) != len(coefficient):
            raise ValueError(
                'noise_distance and noise_coefficient must have one value each per row of the '
                f'table, got {len(distance)} and {len(coefficient)}'
            )
        if list(distance) != sorted(set(distance)):
            raise ValueError(f'noise_distance must increase, got {list(distance)}')
        if min(coefficient) <= 0.0:
            raise ValueError(f'noise_coefficient must be greater than 0, got {list(coefficient)}')
        return self

    @cached_property
    def directions(self) -> np.ndarray:
        """
        (rows * columns, 3) unit rays in the sensor frame (x optical axis), row-major.

        Columns step along sensor y, rows along sensor z.
        """
        half = np.radians(self.fov_deg) / 2.0

        def centres(count: int) -> np.ndarray:
            unit = (np.arange(count) + 0.5) / count * 2.0 - 1.0
            return unit * np.tan(half) if self.grid == 'uniform_tangent' else np.tan(unit * half)

        columns = centres(self.columns)[:: -1 if self.flip_columns else 1]
        rows = centres(self.rows)[:: -1 if self.flip_rows else 1]
        z, y = np.meshgrid(rows, columns, indexing='ij')
        rays = np.stack([np.ones_like(y), y, z], axis=-1).reshape(-1, 3)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def sigma(self, ranges: np.ndarray) -> np.ndarray:
        """Give the standard deviation [m] of a measured distance [m], Table I (same shape)."""
        return np.interp(ranges, self.noise_distance, self.noise_coefficient) * ranges


class ImuModel(Settings):
    """Datasheet of a gyro and accelerometer."""

    rate: float = Field(100.0, gt=0.0, description='samples per second')
    gyro_sigma: float = Field(0.01, gt=0.0, description='white noise of one sample [rad/s]')
    gyro_bias_sigma: float = Field(
        0.0, ge=0.0, description='spread of the constant zero-rate offset [rad/s]'
    )
    gyro_range: float = Field(8.73, gt=0.0, description='full scale [rad/s]')
    accel_sigma: float = Field(0.05, gt=0.0, description='white noise of one sample [m/s^2]')
    accel_range: float = Field(39.2, gt=0.0, description='full scale [m/s^2]')


class StrainModel(Settings):
    """An FBG-like strain sensor down the backbone."""

    spacing: float = Field(0.03, gt=0.0, description='distance between stations [m]')
    rate: float = Field(20.0, gt=0.0, description='samples per second')
    kappa_sigma: float = Field(0.01, gt=0.0, description='white noise of the curvature [1/m]')
    theta_sigma: float = Field(
        0.015, gt=0.0, description='white noise of the bending-plane angle [rad]'
    )
    scale: float = Field(1.0, gt=0.1, lt=10.0, description='curvature read over curvature')
    twist_deg: float = Field(0.0, description='of the sensor about the backbone [deg]')
    offset: tuple[float, float] = Field(
        (0.0, 0.0), description='bending strain about y and z read where there is none [1/m]'
    )
    clock: float = Field(0.0, description='true time less stamp [s]')


class Tolerances(Settings):
    """
    How far a robot may be from its description, 1 sigma: what people build and buy.

    0 says that something is exactly as described.
    """

    mount_position: float = Field(0.002, ge=0.0, description='of a sensor, per axis [m]')
    mount_rotation_deg: float = Field(1.0, ge=0.0, description='of a sensor, per axis [deg]')
    range_offset: float = Field(0.008, ge=0.0, description='of a ToF sensor [m]')
    range_scale: float = Field(0.015, ge=0.0, description='of a ToF sensor, relative')
    gyro_scale: float = Field(0.02, ge=0.0, description='of each axis, relative')
    gyro_axes_deg: float = Field(2.0, ge=0.0, description='of each axis from its place [deg]')
    strain_scale: float = Field(0.03, ge=0.0, description='relative')
    strain_twist_deg: float = Field(5.0, ge=0.0, description='about the backbone [deg]')
    strain_offset: float = Field(0.05, ge=0.0, description='of either bending [1/m]')
    clock: float = Field(0.015, ge=0.0, description='of each board [s]')
    delay: float = Field(0.005, ge=0.0, description='of each sensor beside its board [s]')
    base_position: float = Field(0.005, ge=0.0, description='per axis [m]')
    base_rotation_deg: float = Field(0.7, ge=0.0, description='per axis [deg]')
    map_position: float = Field(0.0, ge=0.0, description='of the map, per axis [m]')
    map_rotation_deg: float = Field(0.0, ge=0.0, description='of the map, per axis [deg]')
    length: float = Field(0.003, ge=0.0, description='of the backbone, relative')

    @property
    def mount_sigma(self) -> np.ndarray:
        """(6,) of a sensor's mount [m, rad]."""
        return _six(self.mount_position, self.mount_rotation_deg)

    @property
    def base_sigma(self) -> np.ndarray:
        """(6,) of the base as built [m, rad]."""
        return _six(self.base_position, self.base_rotation_deg)


class HallModel(Settings):
    """Datasheet of a three-axis Hall sensor (MLX90393 at GAIN 7, RES 0 unless changed)."""

    rate: float = Field(100.0, gt=0.0, description='samples per second')
    sigma: float = Field(1e-6, gt=0.0, description='white noise of one sample [T]')
    lsb: Vector3 = Field(
        (0.150e-6, 0.150e-6, 0.242e-6), description='quantisation step per axis [T]'
    )
    saturation: Vector3 = Field((4.9e-3, 4.9e-3, 7.9e-3), description='full scale per axis [T]')


class Magnet(Settings):
    """The axially magnetised ring magnet at the base; its axis is the base's x."""

    length: float = Field(0.013, gt=0.0)
    inner_diameter: float = Field(0.010, ge=0.0)
    outer_diameter: float = Field(0.014, gt=0.0)
    remanence: float = Field(1.45, description='signed: negative when mounted upside down [T]')
    s: float = Field(0.0, description="arclength of the magnet's centre [m]")


class RobotDescription(Settings):
    """Everything that simulator and estimator share about one robot."""

    name: Name
    length: float = Field(gt=0.0, description='unstretched backbone length [m]')
    radius: float = Field(gt=0.0, description='outer radius of the body [m]')
    base: Base = Base()
    backbone: Backbone = Backbone()
    rings: tuple[Ring, ...] = Field(min_length=1)
    tof_model: TofModel = TofModel()
    tof: tuple[TofSensor, ...] = ()
    imu_model: ImuModel = ImuModel()
    imu: tuple[ImuSensor, ...] = ()
    strain: StrainModel | None = None
    hall_model: HallModel = HallModel()
    hall: tuple[Sensor, ...] = ()
    magnet: Magnet | None = None
    trackers: tuple[Sensor, ...] = ()
    tolerances: Tolerances = Tolerances()
    actuation: Actuation | None = None

    @model_validator(mode='after')
    def _consistent(self) -> RobotDescription:
        _check_units(self)
        arclengths = [ring.s for ring in self.rings]
        if any(b - a < 1e-6 for a, b in zip(arclengths, arclengths[1:], strict=False)):
            raise ValueError(
                f'rings must be listed from base to tip without overlap, got s = {arclengths}'
            )
        if arclengths[-1] > self.length + 1e-9:
            raise ValueError(
                f"ring '{self.rings[-1].name}' at s = {arclengths[-1]} lies beyond the length "
                f'{self.length}'
            )
        names = Counter(one.name for one in (*self.sensors, *self.rings))
        doubled = sorted(name for name, count in names.items() if count > 1)
        if doubled:
            raise ValueError(f'names must be unique, used more than once: {", ".join(doubled)}')
        rings = set(self.ring_names)
        for sensor in self.sensors:
            if sensor.ring not in rings:
                raise ValueError(
                    f"sensor '{sensor.name}' is on unknown ring '{sensor.ring}'; "
                    f'rings: {", ".join(self.ring_names)}'
                )
        for sensor in self.tof:
            self._check_outside(sensor)
        if self.actuation is not None:
            self.actuation.check(self.length, self.radius, self.backbone.module_ends)
        return self

    def _check_outside(self, sensor: Sensor) -> None:
        """Refuse a ToF sensor that looks at its own body from within, but for one at an end."""
        T = sensor.mount.T_ring_sensor
        if np.linalg.norm(T[1:3, 3]) >= self.radius - 1e-9:
            return
        s = self.ring_arclengths[self.ring_names.index(sensor.ring)] + T[0, 3]
        if s >= self.length - self.radius and T[0, 0] >= 0.5:
            return
        raise ValueError(
            f"ToF sensor '{sensor.name}' sits inside the body (radius {self.radius} m) at "
            f's = {s:g} m: move it to the surface or beyond; only at the tip may one look forward '
            'from within'
        )

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All ring-mounted sensors."""
        return self.tof + self.imu + self.hall + self.trackers

    @property
    def ring_names(self) -> tuple[str, ...]:
        """Ring names, base to tip."""
        return tuple(ring.name for ring in self.rings)

    @cached_property
    def ring_arclengths(self) -> np.ndarray:
        """(R,) arclength of each ring [m]."""
        return np.array([ring.s for ring in self.rings])

    @cached_property
    def strain_stations(self) -> np.ndarray:
        """
        (M,) arclengths of the strain stations [m].

        Half a spacing from the base, then every spacing.
        """
        if self.strain is None:
            return np.empty(0)
        spacing = self.strain.spacing
        return np.arange(spacing / 2.0, self.length, spacing)

    def sensor(self, name: str) -> Sensor:
        """
        Return the sensor called `name`.

        Raises KeyError listing the valid names.
        """
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise KeyError(
            f"robot '{self.name}' has no sensor '{name}'; sensors: "
            f'{", ".join(sensor.name for sensor in self.sensors)}'
        )

    def sensor_arclength(self, name: str) -> float:
        """Arclength [m] of the ring that carries the sensor."""
        return float(self.ring_arclengths[self.ring_names.index(self.sensor(name).ring)])


def _check_units(robot: RobotDescription) -> None:
    """Refuse lengths that no continuum robot has: a file in millimetres."""
    far = LONGEST_ARM + 10.0 * robot.radius
    lengths = [
        ('length', robot.length, LONGEST),
        ('radius', robot.radius, THICKEST),
        *((f"the mount of '{one.name}'", _reach(one.mount), far) for one in robot.sensors),
        *((f"'s' of ring '{ring.name}'", ring.s, 10.0 * robot.length) for ring in robot.rings),
        ('base.sigma_position', robot.base.sigma_position, LONGEST),
        ('tof_model.max_range', robot.tof_model.max_range, LONGEST),
    ]
    if robot.strain is not None:
        lengths.append(('strain.spacing', robot.strain.spacing, 10.0 * robot.length))
    if robot.magnet is not None:
        lengths.append(('magnet.outer_diameter', robot.magnet.outer_diameter, 2.0 * THICKEST))
    for name, length, most in lengths:
        if length > most:
            raise ValueError(
                f'{name} of {length:g} m is more than the {most:g} m that are possible here; it '
                f'looks like millimetres: write metres ({1e-3 * length:g})'
            )


def _reach(mount: Mount) -> float:
    """Distance [m] of a mount from its ring's centre, without building its pose."""
    return mount.radius if mount.xyz is None else float(np.linalg.norm(mount.xyz))


def load_robot(name_or_path: str | Path) -> RobotDescription:
    """Load a robot of the package (`engine`, `soft_arm`, `hall_arm`) or one of your own (YAML)."""
    return load_bundled(RobotDescription, ROBOTS_FOLDER, name_or_path, 'robot')
