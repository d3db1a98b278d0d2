"""
Recorded trials of a tendon-driven robot as measurements, truth and bags.

They are CSV files of the University of Toronto.

A trial is a folder of CSV files: `sensor type:,<type>`, a header, then rows `timestamp (s),
arclength (m), data...`:

- aurora*: poses of an electromagnetic tracker, data = xi [rho; phi] with T_map_body = Exp(xi);
- gyro_*: angular velocity in the body frame, rad/s;
- vicon*: poses by motion capture, of the same form: the truth.

Tracked poses that a logger only held are dropped, and the stamps of the others are evened out
(`measured_anew`).

Their body frame has the backbone's tangent along z, ours along x. The axes are renamed, x y z <- z
x y, by a constant rotation on the right of every pose (T_map_body <- T_map_body T_THEIRS_OURS) and
its inverse on the left of every angular velocity; the map's axes stay theirs. A sensor is told by
its arclength, which the robot description names.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from continuum_loc import lie
from continuum_loc.errors import BagError
from continuum_loc.measurements import (
    ImuSample,
    Measurement,
    nanoseconds,
    TrackedPose,
    TruthSample,
)
from continuum_loc.robot import RobotDescription, Sensor
import numpy as np
from scipy.ndimage import uniform_filter1d

# Some recordings begin a little before their time zero, and stamps in ROS are not negative.
STAMP_OF_ZERO = nanoseconds(10.0)
R_THEIRS_OURS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
T_THEIRS_OURS = np.block([[R_THEIRS_OURS, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
ARCLENGTH_TOLERANCE = 1e-3  # [m]
# Samples: several rounds of a logging grid's pattern, short against a clock's drift.
EVENED_OVER = 16
VALUES = {'aurora': 6, 'vicon': 6, 'gyro': 3}


@dataclass(frozen=True, eq=False)
class Recording:
    """
    A trial: measurements in the order of their stamps, and what motion capture saw.

    For each ring that it saw: its stamps (K,) in ns and true poses T_map_ring (K, 4, 4).
    """

    measurements: list[Measurement]
    truth: dict[str, tuple[np.ndarray, np.ndarray]]

    def truth_samples(self, robot: RobotDescription) -> list[TruthSample]:
        """
        Yield the whole body wherever motion capture saw all rings at once.

        The base's pose is that of the ring there.
        """
        rings = [self._ring_at(robot, s) for s in (0.0, *robot.ring_arclengths)]
        stamps = set.intersection(*(set(self.truth[ring][0].tolist()) for ring in rings))
        index = {
            ring: {stamp: k for k, stamp in enumerate(self.truth[ring][0].tolist())}
            for ring in rings
        }
        return [
            TruthSample(
                stamp, np.stack([self.truth[ring][1][index[ring][stamp]] for ring in rings])
            )
            for stamp in sorted(stamps)
        ]

    def _ring_at(self, robot: RobotDescription, s: float) -> str:
        ring = robot.ring_names[int(np.argmin(np.abs(robot.ring_arclengths - s)))]
        if ring not in self.truth:
            raise BagError(
                f"the trial has no true pose of ring '{ring}'; of: {', '.join(self.truth)}"
            )
        return ring


@dataclass(frozen=True, eq=False)
class _File:
    """One CSV file: sensor type, stamps (K,) in ns, arclength [m] and values (K, 3 or 6)."""

    path: Path
    kind: str
    stamps: np.ndarray
    s: float
    values: np.ndarray


def read_recording(
    folder: str | Path, robot: RobotDescription, as_logged: bool = False
) -> Recording:
    """
    Read a trial's folder, for the robot whose description says which sensor sits where.

    as_logged: keep held poses and the logger's own stamps. Raises BagError.
    """
    folder = Path(folder)
    paths = sorted(folder.glob('*.csv'))
    if not paths:
        raise BagError(f'{folder}: no .csv files there; give the folder of one trial')
    measurements: list[Measurement] = []
    truth = {}
    for file in map(_read, paths):
        if file.kind == 'vicon':
            truth[_ring_name(file, robot)] = (file.stamps, lie.exp(file.values) @ T_THEIRS_OURS)
        else:
            if file.kind == 'aurora' and not as_logged:
                file = replace(file, **measured_anew(file.stamps, file.values))
            measurements += _tracked(file, robot) if file.kind == 'aurora' else _rates(file, robot)
    measurements.sort(key=lambda sample: (sample.stamp, sample.sensor))
    return Recording(measurements, truth)


def import_trial(folder: str | Path, bag: str | Path, robot: RobotDescription) -> dict[str, int]:
    """Write a trial's measurements and truth into a new bag; how many messages of each topic."""
    from msg_tools.bag import BagWriter

    recording = read_recording(folder, robot)
    samples = sorted(
        recording.measurements + recording.truth_samples(robot), key=lambda sample: sample.stamp
    )
    counts: dict[str, int] = {}
    with BagWriter(bag) as writer:
        for sample in samples:
            topic = _topic(sample)
            writer.write(topic, sample)
            counts[topic] = counts.get(topic, 0) + 1
    return counts


def _topic(sample: Measurement | TruthSample) -> str:
    if isinstance(sample, TruthSample):
        return 'ground_truth/poses'
    return f'tracker/{sample.sensor}' if isinstance(sample, TrackedPose) else 'imu/data_raw'


def _tracked(file: _File, robot: RobotDescription) -> list[Measurement]:
    sensor = _sensor_at(file, robot, robot.trackers, 'tracker')
    poses = lie.exp(file.values) @ T_THEIRS_OURS @ sensor.mount.T_ring_sensor
    return [
        TrackedPose(int(stamp), sensor.name, T)
        for stamp, T in zip(file.stamps, poses, strict=True)
    ]


def measured_anew(stamps: np.ndarray, values: np.ndarray) -> dict[str, np.ndarray]:
    """
    Drop rows that only repeat the one before, and space the stamps of the others evenly.

    A logger that runs faster than its device holds the last sample: the tracker's 40 Hz on a grid
    of 50 Hz repeat every fifth row, and each stamp is late by up to a step of the grid, which at
    1 m/s is 2 cm. The stamps become multiples of the device's period about their own running
    mean. Rows (K,) and (K, D); without a repeat they stay as they are.
    """
    fresh = np.append(True, np.any(np.diff(values, axis=0) != 0.0, axis=1))
    kept, span = stamps[fresh], EVENED_OVER
    if np.all(fresh) or len(kept) <= span:
        return {'stamps': kept, 'values': values[fresh]}
    period = np.median(kept[span:] - kept[:-span]) / span
    number = np.append(0, np.cumsum(np.maximum(1, np.floor(np.diff(kept) / period + 0.35))))
    late = uniform_filter1d(kept - number * period - kept[0], span, mode='nearest')
    evened = kept[0] + np.round(number * period + late).astype(np.int64)
    return {'stamps': evened, 'values': values[fresh]}


def _rates(file: _File, robot: RobotDescription) -> list[Measurement]:
    sensor = _sensor_at(file, robot, robot.imu, 'gyro')
    rates = file.values @ R_THEIRS_OURS @ sensor.mount.T_ring_sensor[:3, :3]
    nothing = np.full(3, np.nan)  # the accelerometer was not recorded
    return [
        ImuSample(int(stamp), sensor.name, rate, nothing)
        for stamp, rate in zip(file.stamps, rates, strict=True)
    ]


def _sensor_at(
    file: _File, robot: RobotDescription, sensors: tuple[Sensor, ...], kind: str
) -> Sensor:
    for sensor in sensors:
        if abs(robot.sensor_arclength(sensor.name) - file.s) < ARCLENGTH_TOLERANCE:
            return sensor
    places = ', '.join(f'{robot.sensor_arclength(sensor.name):g}' for sensor in sensors) or 'none'
    raise BagError(
        f"{file.path}: robot '{robot.name}' has no {kind} at s = {file.s:g} m; "
        f'it has some at: {places}'
    )


def _ring_name(file: _File, robot: RobotDescription) -> str:
    distance = np.abs(robot.ring_arclengths - file.s)
    if distance.min() > ARCLENGTH_TOLERANCE:
        raise BagError(
            f"{file.path}: robot '{robot.name}' has no ring at s = {file.s:g} m; rings at: "
            f'{", ".join(f"{s:g}" for s in robot.ring_arclengths)}'
        )
    return robot.ring_names[int(np.argmin(distance))]


def _read(path: Path) -> _File:
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BagError(f'{path}: cannot be read ({error})') from None
    kind = (
        lines[0].partition(',')[2].strip()
        if lines and lines[0].startswith('sensor type:')
        else None
    )
    if kind not in VALUES:
        raise BagError(
            f'{path}: the first line must be `sensor type:,` and one of {", ".join(VALUES)}, '
            f'got {lines[0] if lines else "an empty file"!r}'
        )
    rows = _numbers(path, lines[2:], 2 + VALUES[kind])
    if np.ptp(rows[:, 1]) > 0.0:
        raise BagError(
            f'{path}: arclengths from {rows[:, 1].min():g} to {rows[:, 1].max():g} m; '
            'a file holds one sensor'
        )
    stamps = STAMP_OF_ZERO + np.round(rows[:, 0] * 1e9).astype(np.int64)
    if stamps[0] < 0 or np.any(np.diff(stamps) <= 0):
        raise BagError(
            f'{path}: time stamps must increase from row to row and begin after '
            f'{-STAMP_OF_ZERO * 1e-9:g} s'
        )
    return _File(path, kind, stamps, float(rows[0, 1]), rows[:, 2:])


def _numbers(path: Path, lines: list[str], width: int) -> np.ndarray:
    """(K, width) finite numbers; line 3 of the file is the first."""
    if not lines:
        raise BagError(f'{path}: no rows after the header')
    rows = np.empty((len(lines), width))
    for k, line in enumerate(lines):
        fields = line.split(',')
        try:
            rows[k] = [float(field) for field in fields]
        except ValueError:
            raise BagError(
                f'{path}, line {k + 3}: expected {width} numbers, got {line!r}'
            ) from None
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise BagError(f'{path}, line {bad[0] + 3}: a value is not finite: {lines[bad[0]]!r}')
    return rows
