"""How many beams went clear through a place: what has been seen through is empty."""

from __future__ import annotations

from continuum_loc.compiling import kernel
from continuum_loc.errors import MapError
from continuum_loc.mapping.grid import AXIS_BITS, find, hash_table
from continuum_loc.scene.splat_cast import next_cell, start_march
import numpy as np


def passes(
    cells: np.ndarray,
    edge: float,
    origins: np.ndarray,
    directions: np.ndarray,
    lengths: np.ndarray,
) -> np.ndarray:
    """
    Count the beams that run through each cell, all of it, within their length.

    cells: (C, 3) whole numbers, each once: the cell's corner in units of `edge` [m]. origins,
    directions: (N, 3) [m], unit; lengths: (N,) [m]. Returns (C,). Raises MapError where the cells
    are too small to be counted across the scene.
    """
    counts = np.zeros(len(cells), np.int64)
    if len(cells) == 0:
        return counts
    corner = cells.min(axis=0)
    extent = cells.max(axis=0) - corner + 1
    if extent.max() >= 1 << AXIS_BITS:
        raise MapError(
            f'cells of {edge} m are too small for a scene {edge * extent.max():.3g} m across'
        )
    slots = hash_table(cells - corner)
    beams = (np.ascontiguousarray(part, np.float64) for part in (origins, directions, lengths))
    _count(slots, edge * corner.astype(np.float64), extent, edge, *beams, counts)
    return counts


@kernel
def _count(slots, corner, extent, edge, origins, directions, lengths, counts):
    for ray in range(origins.shape[0]):
        at, step, until, stride = start_march(origins[ray], directions[ray], corner, edge)
        while until.min() < lengths[ray]:  # the cell ends within the beam
            if 0 <= at[0] < extent[0] and 0 <= at[1] < extent[1] and 0 <= at[2] < extent[2]:
                cell = find(slots, at[0], at[1], at[2])
                if cell >= 0:
                    counts[cell] += 1
            next_cell(at, step, until, stride)
