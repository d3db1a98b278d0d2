"""
Tables of motors and a tip's positions, and the recordings that a robot is identified on.

A CSV table has a first line of names: `timestamp` [s]; for each motor one column that ends in its
unit, `_mm` or `_m` (position) or `_N` (tension); `tip_x`, `tip_y`, `tip_z`, in the unit of the
motors' positions, or with `_mm` or `_m` behind; and, if there is one, `pattern_label`, which names
the motion that a row belongs to. Other columns are left aside.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import csv
from dataclasses import dataclass
from pathlib import Path
import re

from continuum_loc.errors import BagError
from continuum_loc.measurements import EncoderSample, nanoseconds, TrackedPose
import numpy as np

UNITS = {'mm': 1e-3, 'm': 1.0, 'N': 1.0}
TIP = ('tip_x', 'tip_y', 'tip_z')
LABEL, TIME = 'pattern_label', 'timestamp'
UNTOLD = 1e6  # [rad^2] variance of a rotation that was not measured
LEAST_ROWS = 30
BLOCK = 20.0  # [s] of a recording without labels that belong together


@dataclass(frozen=True, eq=False)
class Recording:
    """
    S samples of M motors and of a tip's position.

    time: (S,) [s]; motors: names; moved: (S, M) positions [m] or tensions [N]; tip: (S, 3) [m] in
    the frame of whoever measured it; pattern: (S,) which motion each belongs to.
    """

    time: np.ndarray
    motors: tuple[str, ...]
    moved: np.ndarray
    tip: np.ndarray
    pattern: np.ndarray


def read_csv(path: Path) -> Recording:
    """Read a table. Raises BagError for one that cannot be used, with the line."""
    try:
        rows = list(csv.reader(path.read_text(encoding='utf-8-sig').splitlines()))
    except (OSError, UnicodeDecodeError) as error:
        raise BagError(f'{path}: cannot be read as a table: {error}') from None
    names = rows[0] if rows else []
    motors = {name: _motor(name) for name in names if name[:4] != 'tip_' and _motor(name)}
    tip = [_tip_column(names, axis) for axis in TIP]
    if TIME not in names or not motors or None in tip:
        raise BagError(
            f'{path}: the first line names {", ".join(names) or "nothing"}; needed are '
            f'`{TIME}`, motors that end in _mm, _m or _N, and {", ".join(TIP)}'
        )
    units = {_unit(name) for name in motors}
    if len(units) > 1:
        raise BagError(f'{path}: motors are in {" and ".join(sorted(units))}; valid: one unit')
    table = _numbers(path, rows, [TIME, *motors, *tip])
    own = units.pop()
    unit = [UNITS.get(_unit(name), UNITS[own]) for name in tip]
    time, moved, places = np.split(table, [1, 1 + len(motors)], axis=1)
    return Recording(
        time[:, 0],
        tuple(motors.values()),
        moved * UNITS[own],
        places * unit,
        _patterns(names, rows, time[:, 0]),
    )


def _unit(name: str) -> str:
    return name.rpartition('_')[2]


def _motor(name: str) -> str:
    """Name of the motor of a column, '' where it is none's."""
    found = re.fullmatch(r'(.+)_(mm|m|N)', name)
    return found[1] if found else ''


def _tip_column(names: Sequence[str], axis: str) -> str | None:
    return next((name for name in names if name in (axis, f'{axis}_mm', f'{axis}_m')), None)


def _numbers(path: Path, rows: list[list[str]], columns: list[str]) -> np.ndarray:
    where = [rows[0].index(name) for name in columns]
    out = np.empty((len(rows) - 1, len(where)))
    for line, row in enumerate(rows[1:]):
        try:
            out[line] = [float(row[column]) for column in where]
        except (IndexError, ValueError):
            raise BagError(
                f'{path}: line {line + 2}: not a number in each of {", ".join(columns)}'
            ) from None
    if len(out) < LEAST_ROWS or not np.isfinite(out).all():
        raise BagError(f'{path}: {len(out)} rows; needed are {LEAST_ROWS}, all finite')
    if np.any(np.diff(out[:, 0]) < 0.0):
        line = int(np.argmax(np.diff(out[:, 0]) < 0.0)) + 3
        raise BagError(f'{path}: line {line}: time goes back')
    return out


def _patterns(names: Sequence[str], rows: list[list[str]], time: np.ndarray) -> np.ndarray:
    """Name the motion of each row, by its label without a trailing `_hold`, or by blocks."""
    if LABEL not in names:
        return np.array([f'block{int((t - time[0]) // BLOCK)}' for t in time])
    column = names.index(LABEL)
    return np.array([row[column].removesuffix('_hold') for row in rows[1:]])


def together(recordings: Sequence[Recording]) -> Recording:
    """One recording of several, in the order of time; rows that two of them hold are kept once."""
    first = recordings[0]
    for other in recordings[1:]:
        if other.motors != first.motors:
            raise BagError(
                f'recordings of different motors: {", ".join(first.motors)}; and '
                f'{", ".join(other.motors)}'
            )
    time = np.concatenate([one.time for one in recordings])
    _, order = np.unique(time, return_index=True)
    return Recording(
        time[order],
        first.motors,
        np.concatenate([one.moved for one in recordings])[order],
        np.concatenate([one.tip for one in recordings])[order],
        np.concatenate([one.pattern for one in recordings])[order],
    )


def samples(recording: Recording, tracker: str, tension: bool = False) -> Iterator:
    """
    Yield a recording as measurements: joint states, and the tip as a tracked pose.

    Of the pose only the position is known: its rotation has a variance of 1e6 rad^2.
    """
    covariance = np.diag([1e-6] * 3 + [UNTOLD] * 3)
    nothing = np.full(len(recording.motors), np.nan)
    for time, moved, tip in zip(recording.time, recording.moved, recording.tip, strict=True):
        stamp, T = nanoseconds(time), np.eye(4)
        T[:3, 3] = tip
        pair = (nothing, moved) if tension else (moved, nothing)
        yield EncoderSample(stamp, recording.motors, *pair)
        yield TrackedPose(stamp, tracker, T, covariance)
