"""
One surface from many beams: measured points that agree are joined into surfels with a covariance.

A range's noise is independent from beam to beam and averages out; the error of the pose that a
beam was placed by is shared by all beams of that time and does not. So a surfel's variance along
its normal is the information-weighted mean's for the ranges' share, and the mean of its points'
for the poses' share (paper, eq. 11, split into its two terms).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from continuum_loc.errors import MapError
from continuum_loc.formats.ply_writer import write_ply
from continuum_loc.scene.reconstruct import Reconstruction
from continuum_loc.settings import Settings
import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

CHUNK = 20_000  # surfels fitted at a time
SAME_SIDE = 0.2  # cosine between the beams of groups that see the same side of a thin part
FLAT = 0.001  # m by which a surface departs from a plane within the radius
LEAST_SIGMA = 1e-4  # m: no range is better than this
UPPER = np.triu_indices(3)


class FusionSettings(Settings):
    """How measured points are joined."""

    cell: float = Field(
        0.01, gt=0.0, description='edge of the cells, each of one surfel a side [m]'
    )
    radius: float = Field(
        0.03, gt=0.0, description='how far round a surfel points speak of the same plane [m]'
    )
    neighbours: int = Field(48, ge=3, description='most cells that a plane is fitted to')
    rounds: int = Field(
        4, ge=1, description='fits of a plane, each without what lies off the last'
    )
    gate: float = Field(
        2.5, gt=0.0, description='standard deviations off the plane at which a cell is left out'
    )
    min_beams: int = Field(
        10, ge=1, description='beams that a surfel needs: fewer are as often strays as a surface'
    )


@dataclass(frozen=True, eq=False)
class FusedScene:
    """
    G surfels in `map`.

    points: (G, 3) [m]; normals: (G, 3) unit, toward where they were seen from; covariance: (G, 3,
    3) [m^2]: along the normal that of the fused height, along the tangents that of a point within
    the cell; beams: (G,) how many points speak in each.
    """

    points: np.ndarray
    normals: np.ndarray
    covariance: np.ndarray
    beams: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(G,) standard deviation along the normal [m]."""
        return np.sqrt(np.einsum('gi,gij,gj->g', self.normals, self.covariance, self.normals))

    def save(self, path: str | Path) -> None:
        """Write a `.ply` with x, y, z, normal, sigma along it, covariance and beams."""
        if Path(path).suffix.lower() != '.ply':
            raise MapError(f'{path}: a scene is written as .ply')
        rows, columns = UPPER
        names = ('cxx', 'cxy', 'cxz', 'cyy', 'cyz', 'czz')
        upper = self.covariance[:, rows, columns].T.astype(np.float32)
        write_ply(
            path,
            dict(zip('xyz', self.points.T, strict=True))
            | dict(zip(('nx', 'ny', 'nz'), self.normals.T.astype(np.float32), strict=True))
            | {'sigma': self.sigma.astype(np.float32)}
            | dict(zip(names, upper, strict=True))
            | {'beams': self.beams.astype(np.int32)},
        )


def fuse(reconstruction: Reconstruction, settings: FusionSettings | None = None) -> FusedScene:
    """
    Join the points of a reconstruction into surfels.

    Points of one cell that were seen from the same side (of six) are one group. It is moved along
    the normal onto the plane of the groups round it, fitted again and again without those that lie
    off it. Where groups of one side then share a cell, the best known stays.
    """
    settings = settings or FusionSettings()
    if len(reconstruction.points) == 0:
        raise MapError('no points to fuse')
    groups = _Groups.of(reconstruction, settings.cell)
    tree = cKDTree(groups.mean)
    batches = range(0, len(groups.weight), CHUNK)
    fitted = [_fit(groups, tree, slice(start, start + CHUNK), settings) for start in batches]
    points, normals, variance, beams = (np.concatenate(part) for part in zip(*fitted, strict=True))
    known = np.flatnonzero(beams >= settings.min_beams)
    known = known[np.argsort(variance[known], kind='stable')]
    kept = known[
        np.unique(_keys(points[known], normals[known], settings.cell), return_index=True)[1]
    ]
    points, normals, variance = points[kept], normals[kept], variance[kept]
    tangential = settings.cell**2 / 12.0
    covariance = tangential * np.eye(3) + (variance - tangential)[:, None, None] * _outer(normals)
    return FusedScene(points, normals, covariance, beams[kept])


class _Groups(NamedTuple):
    """
    G groups of points, each of one cell and side.

    weight: (G,) sum of 1 / variance of the ranges; mean, scatter: (G, 3) [m], (G, 3, 3) [m^2] of
    the points so weighted; toward: (G, 3) mean direction back along the beams; pose: (G, 3, 3)
    [m^2] mean of the poses' share of the covariance; beams: (G,) how many.
    """

    weight: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray
    toward: np.ndarray
    pose: np.ndarray
    beams: np.ndarray

    @classmethod
    def of(cls, reconstruction: Reconstruction, cell: float) -> _Groups:
        r = reconstruction
        back = r.origins - r.points
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        _, group, count = np.unique(
            _keys(r.points, back, cell), return_inverse=True, return_counts=True
        )
        order = np.argsort(group, kind='stable')
        starts = np.concatenate([[0], np.cumsum(count)[:-1]])

        def total(values: np.ndarray) -> np.ndarray:
            return np.add.reduceat(values[order], starts, axis=0)

        weight = 1.0 / np.maximum(r.range_sigma, LEAST_SIGMA) ** 2
        summed = total(weight)
        mean = total(weight[:, None] * r.points) / summed[:, None]
        scatter = total(weight[:, None, None] * _outer(r.points - mean[group]))
        pose = r.covariance - r.range_sigma[:, None, None] ** 2 * _outer(back)
        toward = total(back)
        return cls(
            summed,
            mean,
            scatter / summed[:, None, None],
            toward / np.linalg.norm(toward, axis=1, keepdims=True),
            total(pose) / count[:, None, None],
            count,
        )


def _keys(points: np.ndarray, directions: np.ndarray, cell: float) -> np.ndarray:
    """Return a key (N,) of cell and side; the side is the direction's greatest component."""
    cells = np.floor(points / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    axis = np.argmax(np.abs(directions), axis=1)
    side = 2 * axis + (directions[np.arange(len(axis)), axis] > 0.0)
    extent = cells.max(axis=0) + 1
    return ((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]) * 6 + side


def _fit(groups: _Groups, tree: cKDTree, rows: slice, settings: FusionSettings):
    """Fit surfels of some groups: points, normals (g, 3), variance along them, beams (g,)."""
    own, toward = groups.mean[rows], groups.toward[rows]
    distance, near = tree.query(own, k=settings.neighbours, distance_upper_bound=settings.radius)
    absent = near == len(groups.weight)
    near[absent] = 0
    sided = np.einsum('gki,gi->gk', groups.toward[near], toward) > SAME_SIDE
    kernel = np.exp(-2.0 * (distance / settings.radius) ** 2)  # 0 where there is none
    kernel *= sided * groups.weight[near]
    means, single = groups.mean[near] - own[:, None], (groups.beams / groups.weight)[near]
    inside = kernel
    for _ in range(settings.rounds):
        share = inside / inside.sum(axis=1, keepdims=True)
        middle = np.einsum('gk,gki->gi', share, means)
        offsets = means - middle[:, None]
        spread = np.einsum('gk,gkij->gij', share, groups.scatter[near])
        spread += np.einsum('gk,gki,gkj->gij', share, offsets, offsets)
        values, vectors = np.linalg.eigh(spread)
        normal = vectors[:, :, 0]
        normal *= np.where(np.einsum('gi,gi->g', normal, toward) < 0.0, -1.0, 1.0)[:, None]
        height = np.einsum('gki,gi->gk', offsets, normal)
        oblique = np.einsum('gki,gi->gk', groups.toward[near], normal) ** 2
        pose = np.einsum('gi,gkij,gj->gk', normal, groups.pose[near], normal)
        # Of one beam, not of the mean: a cell off the surface holds the beams that erred most.
        expected = oblique * single + pose
        inside = kernel * (height**2 < settings.gate**2 * (expected + FLAT**2))
        inside[:, 0] = kernel[:, 0]
    beams = (groups.beams[near] * (inside > 0.0)).sum(axis=1)
    noise = np.einsum('gk,gk->g', share, expected)
    # What scatters more than its noise is not flat, and the plane says less of where it lies.
    unflat = np.maximum(values[:, 0] - noise * (1.0 + 2.0 * np.sqrt(2.0 / beams)), 0.0)
    variance = np.einsum('gk,gk->g', share**2, oblique / groups.weight[near])
    variance += np.einsum('gk,gk->g', share, pose) + unflat
    points = own - height[:, :1] * normal
    explained = height[:, 0] ** 2 <= settings.gate**2 * (expected[:, 0] + FLAT**2)
    return points, normal, variance, np.where(explained, beams, 0)


def _outer(vectors: np.ndarray) -> np.ndarray:
    return vectors[:, :, None] * vectors[:, None, :]
