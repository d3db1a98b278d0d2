"""Places on a grid of cubes: their keys, a hash table that finds them, their order in space."""

from __future__ import annotations

from continuum_loc.compiling import kernel
import numpy as np

AXIS_BITS = 19  # of a place along one axis in a key
MORTON_BITS = 21  # of a place along one axis in a Morton code


@kernel(inline='always')
def pack(i, j, k):
    """Key of a cube; i, j and k lie in 0 .. 2^AXIS_BITS - 1."""
    return (np.int64(i) << (2 * AXIS_BITS)) | (np.int64(j) << AXIS_BITS) | np.int64(k)


def hash_table(places: np.ndarray) -> np.ndarray:
    """
    Table (H, 2) of keys and numbers in which `find` looks up the cubes at places (C, 3).

    It has open addressing and is at most a quarter full.
    """
    slots = np.full((1 << max(int(4 * len(places) - 1).bit_length(), 4), 2), -1, np.int64)
    _enter(slots, np.ascontiguousarray(places, np.int64))
    return slots


@kernel
def _enter(slots, places):
    for number in range(places.shape[0]):
        key = pack(places[number, 0], places[number, 1], places[number, 2])
        row = _row(slots, key)
        slots[row, 0], slots[row, 1] = key, number


@kernel(inline='always')
def find(slots, i, j, k):
    """Look up the number of the cube at a place; -1 where the table has none."""
    return slots[_row(slots, pack(i, j, k)), 1]


@kernel(inline='always')
def _row(slots, key):
    """Row that holds the key, or the free one where it belongs."""
    mask = slots.shape[0] - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    row = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(mask))
    while slots[row, 0] != key and slots[row, 0] != -1:
        row = (row + 1) & mask
    return row


@kernel
def morton_codes(points, origin, inverse_edge):
    """(P,) Morton code of each point's cube, counted from `origin`; 1 / edge in [1/m]."""
    codes = np.empty(points.shape[0], np.int64)
    for p in range(points.shape[0]):
        i = np.int64(np.floor((points[p, 0] - origin[0]) * inverse_edge))
        j = np.int64(np.floor((points[p, 1] - origin[1]) * inverse_edge))
        k = np.int64(np.floor((points[p, 2] - origin[2]) * inverse_edge))
        codes[p] = (_spread_bits(i) << 2) | (_spread_bits(j) << 1) | _spread_bits(k)
    return codes


@kernel
def _spread_bits(value):
    """Put two zero bits between the lowest MORTON_BITS bits."""
    v = np.int64(value) & 0x1FFFFF
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


def spatial_order(points: np.ndarray, edge: float) -> np.ndarray:
    """Rows (P,) of the points along a Morton curve through cubes of this edge [m]."""
    return np.argsort(morton_codes(points, points.min(axis=0), 1.0 / edge), kind='stable')
