"""
Whether a sensor can mean what it reads: units, axes and signs, before anything is estimated.

Every function takes readings of one sensor and what is known of it, and returns the likely cause
in words ("reads 10,000 times the field of magnet and Earth: gauss?"), or '' where the readings are
plausible or say too little. The caller puts the sensor's name before it.

A sensor is judged by its own readings, by physics that holds whatever the robot does, and by the
description. Estimates are no argument here: they may have bent to the very sensor that is judged,
and then its neighbours would be blamed. So the limits are those of gross errors. A wrong unit is a
factor of 9.8 and more, a wrong axis turns by 90 degrees and more, and everything that a healthy
sensor shows (bias, mounting, noise, motion) is well below.

| what is wrong | seen by | needs |
|---|---|---|
| unit of the field | `field_strength` | bounds of the field at that place |
| unit of the accelerometer | `acceleration` | a second or more; the median is gravity |
| unit of the gyro | `gyro_noise` | a rest, the noise described |
| unit, axes, signs of the gyro | `turns_and_gravity` | a turn of some 15 degrees, no rest |
| axes or signs of any vector | `direction` | the direction expected in the sensor's frame |
"""

from __future__ import annotations

from collections import deque
from itertools import permutations, product

from continuum_loc import lie
import numpy as np

GRAVITY = 9.80665  # [m/s^2]
DEGREES = 180.0 / np.pi
# Factors by which a unit's number is greater than that of tesla, or of m/s^2.
FIELD_UNITS = {1e3: 'millitesla', 1e4: 'gauss', 1e6: 'microtesla', 1e7: 'milligauss', 1e9: 'nT'}
ACCELERATION_UNITS = {1 / GRAVITY: 'g', 1e3 / GRAVITY: 'milli-g', 1e2: 'cm/s^2'}

BLOCK_NS = 100_000_000
BLOCK = 1e-9 * BLOCK_NS  # s: within a block a turn is one rotation vector
SMOOTHED = 5  # blocks: linear accelerations average out over so many


def field_strength(field: np.ndarray, expected: float, least: float, most: float) -> str:
    """
    Judge the unit of a magnetometer by what it reads of a magnet and the Earth.

    field: (K, 3) readings [T], rows that are not finite are left out. expected: the strength that
    the description gives for this place, to name the unit by. least, most: the limits of what any
    healthy sensor of this robot may read, in whatever shape it is.
    """
    size = _median_size(field)
    if not size > 0.0 or least <= size <= most:
        return ''
    factor = min(FIELD_UNITS, key=lambda unit: abs(np.log(_over_one(size / expected) / unit)))
    if not 1 / 3 < _over_one(size / expected) / factor < 3:
        return f'reads {size:.2g} T where magnet and Earth give about {expected:.2g} T'
    if size > expected:
        return f'reads {factor:,.0f} times the field of magnet and Earth: {FIELD_UNITS[factor]}?'
    return (
        f'reads 1/{factor:,.0f} of the field of magnet and Earth: '
        f'taken for {FIELD_UNITS[factor]}, or no magnet?'
    )


def acceleration(accel: np.ndarray) -> str:
    """
    Judge the unit of an accelerometer by gravity.

    accel: (K, 3) specific force [m/s^2] of a second or more; motion does not change its median by
    half, nor do zero-g offsets.
    """
    size = _median_size(accel)
    if not size >= 0.0 or 0.5 * GRAVITY < size < 1.5 * GRAVITY:
        return ''
    for factor, unit in ACCELERATION_UNITS.items():
        if 0.5 < size / (factor * GRAVITY) < 1.5:
            return f'reads {size:.3g} m/s^2 for gravity: {unit}?'
    return f'reads {size:.3g} m/s^2 where gravity is {GRAVITY:.2f}'


def gyro_noise(gyro: np.ndarray, sigma: float) -> str:
    """
    Judge the unit of a gyro at rest by its noise.

    gyro: (K, 3) [rad/s] of a rest. sigma: white noise of one sample as described [rad/s]. Degrees
    per second make the noise of all axes 57 times as large, and leave it white, which no motion
    is. A gyro that is quieter than described is no sign: datasheets state what all units keep.
    """
    if len(gyro) < 30:
        return ''
    spread = np.std(gyro, axis=0) / sigma
    steps = np.std(np.diff(gyro, axis=0), axis=0) / sigma  # sqrt(2) of the spread where white
    white = (steps > 1.1 * spread).all()
    if white and DEGREES / 2.0 < spread.min() and spread.max() < 2.0 * DEGREES:
        return f'is {np.median(spread):.0f} times as noisy as described: degrees per second?'
    return ''


class Turns:
    """
    The last seconds of one IMU in blocks of a tenth, for `turns_and_gravity`.

    A block is a turn, the mean rate over its time, and a mean acceleration. After a gap it begins
    anew.
    """

    def __init__(self, seconds: float = 3.0) -> None:
        self._blocks: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=round(seconds / BLOCK))
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self._blocks.clear()
        self._block = self._count = 0
        self._gyro = self._accel = np.zeros(3)

    def add(self, stamp: int, gyro: np.ndarray, accel: np.ndarray) -> None:
        """Take a sample at `stamp` [ns]: gyro (3,) [rad/s] less its bias, accel (3,) [m/s^2]."""
        block = stamp // BLOCK_NS
        if block != self._block:
            if self._count:
                mean = BLOCK / self._count * self._gyro, self._accel / self._count
                self._blocks.append(mean)
            if block != self._block + 1:
                self._blocks.clear()
            self._block, self._count = block, 0
            self._gyro = self._accel = np.zeros(3)
        self._count += 1
        self._gyro = self._gyro + gyro
        self._accel = self._accel + accel

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Give turns (B, 3) [rad] and accelerations (B, 3) [m/s^2] of the blocks, oldest first."""
        both = np.array(self._blocks).reshape(-1, 2, 3)
        return both[:, 0], both[:, 1]


def turns_and_gravity(turns: Turns, bias: float = 0.0) -> str:
    """
    Judge a gyro by the accelerometer of the same chip: gravity stays put while the chip turns.

    bias: what may be left of the gyro's bias [rad/s]. Carried along by the gyro's turns, the
    measured gravity does not move: then all is well, or nothing has turned. Where it moves, and
    would not if the gyro were in another unit or had other axes or signs, that is the cause.
    Linear accelerations average out over half a second. Turns about gravity itself stay unseen.
    """
    turn, accel = turns.arrays()
    size = np.linalg.norm(accel, axis=1)
    if len(turn) < 2 * SMOOTHED or not (np.abs(size / GRAVITY - 1.0) < 0.25).all():
        return ''
    up = accel / size[:, None]
    if np.ptp(up, axis=0).max() < VISIBLE and np.abs(turn).sum() < VISIBLE:
        return ''
    as_is = _unrest(_frames(turn), up)
    if as_is < VISIBLE + bias * BLOCK * len(turn) / 12**0.5:
        return ''
    left = {name: _unrest(*changed) for name, changed in _changed(turn, up).items()}
    least = min(left.values())
    if least > as_is / 3.0:
        return ''
    return next(name for name, unrest in left.items() if unrest <= 1.5 * least + 0.01)


def direction(read: np.ndarray, expected: np.ndarray, what: str, tolerance: float) -> str:
    """
    Judge the axes and signs of a sensor by a direction that is known.

    read, expected: (3,) in the sensor's frame. what: the name of the vector, for the text.
    tolerance: the angle [rad] that healthy sensors may be off, for all reasons together.
    """
    read, expected = (np.asarray(v, float) / np.linalg.norm(v) for v in (read, expected))
    if not read @ expected < np.cos(tolerance):
        return ''
    text = f'reads {what} along {_axis(read)} where {_axis(expected)} is expected'
    for axes in SIGNED_AXES[1:]:
        if (axes @ read) @ expected > np.cos(tolerance):
            return f'{text}: axes swapped, or a sign off? {named(axes)} would fit'
    return f'{text}: mounted otherwise than described?'


# Shared parts

VISIBLE = 0.1  # rad rms: less unrest of gravity is noise and motion
DIRECTIONS = 'xyz'


def _signed_axes() -> list[np.ndarray]:
    """All 48 ways to exchange axes and signs, (3, 3) each; the likelier ones first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        moved = sum(place != axis for place, axis in enumerate(order))
        flipped = sum(sign < 0.0 for sign in signs)
        found.append((moved + flipped, np.diag(signs) @ np.eye(3)[list(order)]))
    return [axes for _, axes in sorted(found, key=lambda one: one[0])]


SIGNED_AXES = _signed_axes()


def _unrest(frames: np.ndarray, up: np.ndarray) -> float:
    """How far gravity, up (B, 3) of blocks carried by frames (B, 3, 3), moves [rad rms]."""
    gravity = np.einsum('bij,bj->bi', frames, up)
    groups = gravity[: len(gravity) // SMOOTHED * SMOOTHED].reshape(-1, SMOOTHED, 3).mean(axis=1)
    return float(np.sqrt(3.0 * np.mean((groups - groups.mean(axis=0)) ** 2)))


def _changed(turn: np.ndarray, up: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    Frames and gravity for each cause that a gyro may have, likelier ones first.

    Signed axes are P = +-Q with a rotation Q, and a turn by P w is Q exp(+-w) Q^T.
    """
    slow, fast = _frames(turn / DEGREES), _frames(turn * DEGREES)
    found = {
        'turns 57 times too fast for its gravity: degrees per second?': (slow, up),
        'turns 57 times too slowly for its gravity: converted to radians twice?': (fast, up),
    }
    frames = {1.0: _frames(turn), -1.0: _frames(-turn)}
    for axes in SIGNED_AXES[1:]:
        sign = np.sign(np.linalg.det(axes))
        found[
            'turns otherwise than its gravity: axes swapped, or a sign off? '
            f'The gyro as {named(axes)} would fit the accelerometer'
        ] = frames[sign], up @ (sign * axes)
    return found


def _frames(turn: np.ndarray) -> np.ndarray:
    """(B, 3, 3) rotation at the middle of each block, from that at the beginning of the first."""
    halves = lie.so3_exp(0.5 * turn)
    starts = [np.eye(3)]
    for step in (halves @ halves)[:-1]:
        starts.append(starts[-1] @ step)
    return np.array(starts) @ halves


def _median_size(vectors: np.ndarray) -> float:
    size = np.linalg.norm(np.atleast_2d(vectors), axis=1)
    return float(np.median(size[np.isfinite(size)])) if np.isfinite(size).any() else float('nan')


def _over_one(ratio: float) -> float:
    return max(ratio, 1.0 / ratio)


def _axis(v: np.ndarray) -> str:
    """Name the axis nearest to a unit vector, or give the vector."""
    k = int(np.argmax(np.abs(v)))
    if abs(v[k]) < 0.85:
        return '(' + ', '.join(f'{x:.1f}' for x in v) + ')'
    return ('+' if v[k] > 0.0 else '-') + DIRECTIONS[k]


def named(axes: np.ndarray) -> str:
    """Write what has to be read in place of (x, y, z), as in '(y, x, -z)'."""
    names = []
    for row in axes:
        k = int(np.argmax(np.abs(row)))
        names.append(('' if row[k] > 0.0 else '-') + DIRECTIONS[k])
    return f'({", ".join(names)})'
