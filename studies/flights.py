"""
The simulated VL53L5CX beside a real one on public flights of small drones in a room.

The recordings are those of the repository Matrix_ToF_Drones (ETH Zurich, GPL-3), which is not part
of this package: CONTINUUM_LOC_FLIGHTS names its folder `Flight DataSet`. Only the first half of
its list is read, in the list's order; the other half is kept back.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
from typing import Any

from continuum_loc.errors import InputError
from continuum_loc.offline.claims import at_most, between, Claim, write_study
from continuum_loc.simulator.vl53l5cx import Vl53l5cxSettings
import numpy as np
from studies._filter_runs import write_page
from studies._flight_room import simulated_flight
from studies._flight_statistics import (
    BANDS,
    blocks,
    distance_rows,
    Flight,
    flight_row,
    PERIOD_MS,
    SIDE,
    spread,
    STATUSES,
)

VARIABLE = 'CONTINUUM_LOC_FLIGHTS'
# The first 21 of the 43 flights of the list, in its order.
FIRST_HALF = (
    *(f'Approach/A{number}' for number in range(10)),
    *(f'Rotate/R{number}' for number in range(3)),
    *(f'Object/O{number}' for number in range(8)),
)
FILE = 'state_ToF.csv'
FACTOR = 1.3  # by which noise and tails may differ
SIMULATED = 21
SHARES = (*(str(code) for code in STATUSES), '255 short', 'one stamp', 'lost')

TEXT = """
Each zone of a frame is compared with the plane through its eight neighbours, so that nothing has
to be known of the place. *Noise* is the robust deviation where the neighbours lie on a plane to
half a sigma of Table I. *Tails* are residuals beyond three sigmas of Table I: on *flats*, where
the neighbours lie on a plane to one sigma, and at *edges*, everywhere else. Simulated flights go
about halls with panels, chairs, boxes and people; the first sixth of a flight is spent before a
plate, as the real ones stand on the ground before they take off.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Compare the first half of the flights, where they are, with as many simulated ones."""
    real = recorded_flights()
    count = 6 if quick else SIMULATED
    simulated = [simulated_flight(1000 * (seed + 1) + number) for number in range(count)]
    rows = {'real': _rows(real), 'simulated': _rows(simulated)}
    by_distance = {
        'real': distance_rows(blocks(real)) if real else [],
        'simulated': distance_rows(blocks(simulated)),
    }
    claims = judge(rows, by_distance) if real else []
    tables = {
        'shares': share_table(rows),
        'distance': [
            {'flights': kind, **row} for kind, found in by_distance.items() for row in found
        ],
        'flights': [row for found in rows.values() for row in found],
    }
    if not real:
        print(f'{VARIABLE} is not set: no real flights to compare with, so nothing is claimed')
    figures(out, rows, by_distance)
    write_study(
        out,
        claims,
        seed=seed,
        settings={'sensor': Vl53l5cxSettings(), 'flights': FIRST_HALF if real else ()},
        tables=tables,
        extra={'quick': quick},
    )
    write_page(
        out,
        'The VL53L5CX beside a real one',
        TEXT,
        claims,
        {
            'Shares [%] over flights (10th, 50th and 90th percentile)': tables['shares'],
            'By distance': tables['distance'],
        },
    )
    return claims


def recorded_flights() -> list[Flight]:
    """Read the first half of the public flights; none where CONTINUUM_LOC_FLIGHTS is not set."""
    folder = os.environ.get(VARIABLE)
    return [read_flight(Path(folder), name) for name in FIRST_HALF] if folder else []


def read_flight(folder: Path, name: str) -> Flight:
    """
    Read `folder/name/state_ToF.csv`: rows (stamp, 0, 0), each with 64 of (mm, targets, status).

    Raises InputError.
    """
    path = folder / name / FILE
    try:
        table = np.loadtxt(path, delimiter=',', dtype=np.int64, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(
            f'{path}: {error}; {VARIABLE} has to name the folder of the flights, with '
            f'{FIRST_HALF[0]}/{FILE} in it'
        ) from None
    height = SIDE * SIDE + 1
    if table.shape[1] != 3 or len(table) < 2 * height:
        raise InputError(f'{path}: {table.shape} numbers; needed: frames of {height} rows of 3')
    frames = table[: len(table) // height * height].reshape(-1, height, 3)
    grid = (-1, SIDE, SIDE)
    return Flight(
        name, frames[:, 0, 0], frames[:, 1:, 0].reshape(grid), frames[:, 1:, 2].reshape(grid)
    )


def _rows(flights: Sequence[Flight]) -> list[dict[str, Any]]:
    return [flight_row(flight) for flight in flights]


def share_table(rows: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """One row per share, real and simulated side by side."""
    table = []
    for key in SHARES:
        row: dict[str, Any] = {'share [%]': key}
        for kind, found in rows.items():
            if found:
                names = (f'{kind}, 10 %', kind, f'{kind}, 90 %')
                row |= dict(zip(names, spread(found, key), strict=True))
        table.append(row)
    return table


def judge(
    rows: dict[str, list[dict[str, Any]]], by_distance: dict[str, list[dict[str, Any]]]
) -> list[Claim]:
    """Each share lies within the spread of the flights; noise and tails within a factor."""
    claims = []
    for key in SHARES:
        low, _, high = spread(rows['real'], key)
        found = float(np.median([row[key] for row in rows['simulated']]))
        claims.append(
            between(f'share: {key}', round(found, 3), '%', round(low, 3), round(high, 3))
        )
    interval = spread(rows['simulated'], 'interval [ms]')[1]
    claims.append(at_most('interval: apart from 1/15 s', abs(interval - PERIOD_MS), 'ms', 1.0))
    for band, (real, simulated) in enumerate(
        zip(by_distance['real'], by_distance['simulated'], strict=True)
    ):
        low, high = BANDS[band]
        claims.append(_near(f'noise at {low:g} to {high:g} m', simulated, real, 'noise [mm]'))
    for key in ('tails on flats [%]', 'tails at edges [%]'):
        # Bands weigh the same: how often a distance occurs is the room's matter.
        means = {
            kind: {key: float(np.mean([row[key] for row in found]))}
            for kind, found in by_distance.items()
        }
        claims.append(_near(key.removesuffix(' [%]'), means['simulated'], means['real'], key))
    return claims


def _near(name: str, simulated: dict[str, Any], real: dict[str, Any], key: str) -> Claim:
    ratio = simulated[key] / real[key] if real[key] else float('nan')
    return between(f'{name}: simulated over real', ratio, '', round(1.0 / FACTOR, 3), FACTOR)


def figures(
    out: Path,
    rows: dict[str, list[dict[str, Any]]],
    by_distance: dict[str, list[dict[str, Any]]],
) -> None:
    """Draw `flights.png`: shares with their spread, noise and tails by distance."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    out.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.2))
    for offset, (kind, found) in zip((-0.15, 0.15), rows.items(), strict=True):
        if found:
            low, middle, high = np.array([spread(found, key) for key in SHARES]).T
            axes[0].errorbar(
                np.arange(len(SHARES)) + offset,
                middle,
                [middle - low, high - middle],
                fmt='o',
                capsize=3,
                label=kind,
            )
    axes[0].set_xticks(range(len(SHARES)), SHARES, rotation=60)
    axes[0].set(
        ylabel='share [%], 10th to 90th percentile over flights', yscale='symlog', ylim=(0.0, None)
    )
    for kind, found in by_distance.items():
        if found:
            middle = [np.mean(band) for band in BANDS]
            axes[1].plot(middle, [row['noise [mm]'] for row in found], 'o-', label=kind)
            for key, line in (('tails on flats [%]', 'o-'), ('tails at edges [%]', 's--')):
                axes[2].plot(middle, [row[key] for row in found], line, label=f'{kind}: {key}')
    middle = np.array([np.mean(band) for band in BANDS])
    table = [row['Table I [mm]'] for row in by_distance['simulated']]
    axes[1].plot(middle, table, ':', color='grey', label='Table I')
    axes[1].set(xlabel='distance [m]', ylabel='noise where it is smooth [mm]')
    axes[2].set(xlabel='distance [m]', ylabel='beyond 3 sigma of Table I [%]')
    for axis in axes:
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(out / 'flights.png', dpi=110)
    plt.close(figure)
