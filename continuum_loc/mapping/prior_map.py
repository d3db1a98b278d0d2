"""The prior map: a point cloud with normals and planarity (paper, III-D)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
import json
from pathlib import Path

from continuum_loc.errors import MapError
from continuum_loc.formats.ply_writer import write_ply
from continuum_loc.formats.shapes import FARTHEST
from continuum_loc.mapping.voxel_index import VoxelIndex
import numpy as np

CLOUD_COLUMNS = ('x', 'y', 'z', 'nx', 'ny', 'nz', 'planarity')
NPZ_FORMAT = 'continuum_loc prior map 1'


@dataclass(frozen=True, eq=False)
class PriorMap:
    """
    What is known of the environment before the robot enters it, in the frame `map`.

    points: (P, 3) on the surface [m].
    normals: (P, 3) unit; outward from the solid where `oriented`, else of either sign.
    planarity: (P,) alpha = (sigma_2 - sigma_3) / sigma_1 in [0, 1], sigma_i the square roots of
        the eigenvalues of the neighbourhood's covariance (paper, below eq. 1).
    sigma: standard deviation of a point [m] (Sigma_nn of eq. 12 is built from it and from
    `spacing`).
    spacing: typical distance from a point to its nearest neighbour [m].
    notes: what was left out of the file that the map is from, or aside, in words.
    """

    points: np.ndarray
    normals: np.ndarray
    planarity: np.ndarray
    sigma: float = 1e-4
    spacing: float = 0.0
    oriented: bool = True
    source: str = ''
    seed: int | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        _require_columns(self)
        for name in ('points', 'normals', 'planarity'):
            object.__setattr__(
                self, name, np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            )
        _refuse_rows(self, ~np.isfinite(self.points).all(axis=1), 'points must be finite')
        _refuse_rows(
            self,
            np.abs(self.points).max(axis=1) > FARTHEST,
            f'points must be within {FARTHEST:g} m of 0',
        )
        _refuse_rows(
            self,
            ~(np.abs(np.linalg.norm(self.normals, axis=1) - 1.0) < 1e-6),
            'normals must have length 1',
        )
        _refuse_rows(
            self,
            ~((self.planarity >= 0.0) & (self.planarity <= 1.0)),
            'planarity must lie in [0, 1]',
        )
        if not (0.0 < self.sigma < np.inf and 0.0 <= self.spacing < np.inf):
            raise MapError(
                f'{self._name}: sigma must be > 0 and spacing >= 0, and both finite, '
                f'got {self.sigma}, {self.spacing}'
            )

    def __len__(self) -> int:
        return len(self.points)

    @property
    def _name(self) -> str:
        return self.source or 'prior map'

    @cached_property
    def index(self) -> VoxelIndex:
        """Nearest-neighbour index, made once for all users; its rows are rows of this map."""
        return VoxelIndex(self.points, self.normals)

    def moved(self, T: np.ndarray) -> PriorMap:
        """Move every point and normal by T (4, 4)."""
        return replace(
            self,
            points=self.points @ T[:3, :3].T + T[:3, 3],
            normals=self.normals @ T[:3, :3].T,
        )

    def save(self, path: str | Path) -> None:
        """
        Write `.npz` (everything, fast), or `.ply`, `.csv`, `.xyz`.

        The latter hold points, normals and planarity.
        """
        path = Path(path)
        writer = by_suffix(path, _WRITERS, 'written')
        path.parent.mkdir(parents=True, exist_ok=True)
        writer(self, path)

    @property
    def table(self) -> np.ndarray:
        """(P, 7) columns x, y, z, nx, ny, nz, planarity."""
        return np.column_stack([self.points, self.normals, self.planarity])


def by_suffix(path: Path, table: dict[str, Callable], verb: str) -> Callable:
    """
    Choose from `table` by the ending of `path`.

    Raises MapError listing the valid ones.
    """
    if path.suffix.lower() not in table:
        raise MapError(
            f"{path}: a map cannot be {verb} as '{path.suffix}'; valid are {', '.join(table)}"
        )
    return table[path.suffix.lower()]


def _require_columns(prior: PriorMap) -> None:
    count = len(prior.points)
    shapes = tuple(np.shape(getattr(prior, name)) for name in ('points', 'normals', 'planarity'))
    if count == 0 or shapes != ((count, 3), (count, 3), (count,)):
        raise MapError(
            f'{prior._name}: expected points (P, 3), normals (P, 3) and planarity (P,) '
            f'with P >= 1, got {shapes}'
        )


def _refuse_rows(prior: PriorMap, bad: np.ndarray, rule: str) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        raise MapError(
            f'{prior._name}: {rule}; '
            f'{len(rows)} of {len(bad)} rows do not comply, first row {rows[0]}'
        )


# Files (reading them is in `map_files`)


def _write_npz(prior: PriorMap, path: Path) -> None:
    arrays = {name: getattr(prior, name) for name in ('points', 'normals', 'planarity')}
    about = {key: value for key, value in asdict(prior).items() if key not in arrays}
    if not prior.notes:  # so that versions without notes read most maps too
        del about['notes']
    with path.open('wb') as stream:
        np.savez(stream, format=NPZ_FORMAT, about=json.dumps(about), **arrays)


def _write_text(prior: PriorMap, path: Path) -> None:
    comma = path.suffix.lower() == '.csv'
    np.savetxt(
        path,
        prior.table,
        fmt='%.12g',
        delimiter=',' if comma else ' ',
        header=','.join(CLOUD_COLUMNS) if comma else '',
        comments='',
    )


def _write_ply(prior: PriorMap, path: Path) -> None:
    write_ply(path, dict(zip(CLOUD_COLUMNS, prior.table.T, strict=True)))


_WRITERS = {'.npz': _write_npz, '.ply': _write_ply, '.csv': _write_text, '.xyz': _write_text}
