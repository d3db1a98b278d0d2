"""How far any place is from the surface of a map, to the nearest voxel."""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.mapping.prior_map import PriorMap
import numpy as np
from scipy.ndimage import distance_transform_edt

MOST_VOXELS = 12_000_000
FINEST = 0.025  # [m] edge of a voxel
FAR = 0.25  # [m] beyond which a point counts as just off


class DistanceField(NamedTuple):
    """Distance [m] to the nearest point of a map, at the voxels (X, Y, Z) of a box."""

    origin: np.ndarray
    voxel: float
    distance: np.ndarray

    @classmethod
    def of(cls, prior_map: PriorMap) -> DistanceField:
        """Make that of a map, as fine as memory allows."""
        low, high = (f(prior_map.points, axis=0) for f in (np.min, np.max))
        low, span = low - FAR, high - low + 2.0 * FAR
        voxel = max(FINEST, float(np.cbrt(np.prod(span) / MOST_VOXELS)))
        free = np.ones(np.ceil(span / voxel).astype(int) + 1, bool)
        free[tuple(((prior_map.points - low) / voxel).astype(int).T)] = False
        distance = distance_transform_edt(free, sampling=voxel).astype(np.float32)
        return cls(low, voxel, np.minimum(distance, FAR))
