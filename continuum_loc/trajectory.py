"""Trajectories of a whole body: poses of base and rings over time, and their TUM files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from continuum_loc import lie
from continuum_loc.errors import TrajectoryError
from continuum_loc.estimate import Estimate
from continuum_loc.measurements import NANOSECONDS, TruthSample
import numpy as np
from scipy.spatial.transform import Rotation

BASE = 'base'


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    K instants of a body with R rings.

    stamps: (K,) int64 nanoseconds, strictly increasing.
    names: R + 1 names, the base first, then the rings from base to tip.
    T_map_ring: (K, R + 1, 4, 4).
    covariance: (K, R + 1, 6, 6) of a right perturbation, [rho; phi] order, or None (truth has
    none).
    status: (K,) strings (see `Estimate`), or None.
    backbone: (K, B, 3) points of the backbone in `map` [m], base to tip, or None.
    """

    stamps: np.ndarray
    names: tuple[str, ...]
    T_map_ring: np.ndarray
    covariance: np.ndarray | None = None
    status: np.ndarray | None = None
    backbone: np.ndarray | None = None

    def __post_init__(self) -> None:
        count, rings = len(self.stamps), len(self.names)
        expected = {
            'T_map_ring': (count, rings, 4, 4),
            'covariance': (count, rings, 6, 6),
            'status': (count,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise TrajectoryError(
                    f'{name} has shape {value.shape}, expected {shape} (stamps, base and rings)'
                )
        if np.any(np.diff(self.stamps) <= 0):
            raise TrajectoryError('stamps must increase strictly, as `from_estimates` arranges')

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    def from_estimates(
        cls, estimates: Iterable[Estimate], ring_names: Sequence[str]
    ) -> Trajectory:
        """Keep the last estimate made for each instant, in the order of the instants."""
        latest = {estimate.stamp: estimate for estimate in estimates}
        ordered = [latest[stamp] for stamp in sorted(latest)]
        names = (BASE, *ring_names)
        if not ordered:
            return cls.empty(names)
        return cls(
            stamps=np.array([estimate.stamp for estimate in ordered], np.int64),
            names=names,
            T_map_ring=np.stack([estimate.T_map_ring for estimate in ordered]),
            covariance=np.stack([estimate.covariance for estimate in ordered]),
            status=np.array([estimate.status for estimate in ordered]),
            backbone=np.stack([estimate.T_map_backbone[:, :3, 3] for estimate in ordered]),
        )

    @classmethod
    def from_truth(cls, samples: Iterable[TruthSample], ring_names: Sequence[str]) -> Trajectory:
        """Take the recorded truth, in the order of its stamps (of doubled stamps the last)."""
        latest = {sample.stamp: sample.T_map_ring for sample in samples}
        names = (BASE, *ring_names)
        if not latest:
            return cls.empty(names)
        stamps = sorted(latest)
        odd = next((stamp for stamp in stamps if latest[stamp].shape != (len(names), 4, 4)), None)
        if odd is not None:
            raise TrajectoryError(
                f'the truth at {odd / NANOSECONDS:.3f} s holds {len(latest[odd])} poses; '
                f'this robot has {len(names)}: {", ".join(names)}'
            )
        return cls(
            np.array(stamps, np.int64), names, np.stack([latest[stamp] for stamp in stamps])
        )

    @classmethod
    def empty(cls, names: Sequence[str]) -> Trajectory:
        """Make a trajectory without instants."""
        return cls(np.empty(0, np.int64), tuple(names), np.empty((0, len(names), 4, 4)))

    def select(self, mask: np.ndarray) -> Trajectory:
        """Keep the instants where `mask` (K,) is true."""

        def pick(value: np.ndarray | None) -> np.ndarray | None:
            return None if value is None else value[mask]

        return Trajectory(
            self.stamps[mask],
            self.names,
            self.T_map_ring[mask],
            pick(self.covariance),
            pick(self.status),
            pick(self.backbone),
        )

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """
        Poses (N, R + 1, 4, 4) at `stamps` (N,) inside the trajectory.

        Along the geodesic between its neighbours: T(u) = T_a Exp(u Log(T_a^-1 T_b)). Raises
        TrajectoryError for stamps outside.
        """
        stamps = np.asarray(stamps, np.int64)
        if len(stamps) and (
            len(self) < 2 or stamps.min() < self.stamps[0] or stamps.max() > self.stamps[-1]
        ):
            raise TrajectoryError(
                'a trajectory can only be asked for instants between its first and its last stamp'
            )
        after = np.clip(
            np.searchsorted(self.stamps, stamps, side='right'), 1, max(len(self) - 1, 1)
        )
        start, span = self.stamps[after - 1], self.stamps[after] - self.stamps[after - 1]
        share = ((stamps - start) / span)[:, None]
        return lie.interpolate(self.T_map_ring[after - 1], self.T_map_ring[after], share)

    def rings_at(self, stamps: np.ndarray, rings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        T_map_ring (M, 4, 4) and covariance (M, 6, 6) of rings (M,) at `stamps` (M,).

        `rings` are numbers, 0 the base; `stamps` lie within the trajectory, whose only instant may
        be one. Poses go along the geodesic between samples, the covariance linearly in time; it is
        zero where the trajectory has none.
        """
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, max(len(self) - 1, 1))
        before, after = after - 1, np.minimum(after, len(self) - 1)
        span = np.maximum(self.stamps[after] - self.stamps[before], 1)
        share = (stamps - self.stamps[before]) / span
        T_map_ring = lie.interpolate(
            self.T_map_ring[before, rings], self.T_map_ring[after, rings], share
        )
        if self.covariance is None:
            return T_map_ring, np.zeros((len(stamps), 6, 6))
        share = share[:, None, None]
        covariance = (1.0 - share) * self.covariance[before, rings] + share * self.covariance[
            after, rings
        ]
        return T_map_ring, covariance


def associate(
    estimate: Trajectory, truth: Trajectory, longest_gap: float = 0.2
) -> tuple[Trajectory, Trajectory]:
    """
    Pair the estimate where truth is known with the truth interpolated to its stamps.

    Instants outside the truth, or inside a gap of it longer than `longest_gap` [s], are left out.
    """
    if estimate.names != truth.names:
        raise TrajectoryError(
            f'estimate and truth describe different bodies: {", ".join(estimate.names)} against '
            f'{", ".join(truth.names)}'
        )
    known = known_at(truth.stamps, estimate.stamps, longest_gap)
    matched = estimate.select(known)
    return matched, Trajectory(matched.stamps, truth.names, truth.at(matched.stamps))


def known_at(reference: np.ndarray, stamps: np.ndarray, longest_gap: float) -> np.ndarray:
    """
    (K,) whether each stamp is one of `reference`'s, or lies between two of them.

    Those two are at most `longest_gap` [s] apart.
    """
    if len(reference) < 2:
        return np.zeros(len(stamps), bool)
    after = np.clip(np.searchsorted(reference, stamps, side='right'), 1, len(reference) - 1)
    inside = (stamps >= reference[0]) & (stamps <= reference[-1])
    near = reference[after] - reference[after - 1] <= longest_gap * NANOSECONDS
    sampled = (stamps == reference[after - 1]) | (stamps == reference[after])
    return inside & (near | sampled)


def save_tum(track: Trajectory, folder: str | Path, prefix: str) -> list[Path]:
    """
    Write `folder/PREFIX_NAME.tum` for the base and each ring.

    Lines `t x y z qx qy qz qw`, t in seconds to 1 ns.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    times = [
        f'{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}' for stamp in track.stamps.tolist()
    ]
    paths = []
    for index, name in enumerate(track.names):
        T_map_ring = track.T_map_ring[:, index]
        values = np.empty((len(track), 7))
        values[:, :3] = T_map_ring[:, :3, 3]
        values[:, 3:] = (
            Rotation.from_matrix(T_map_ring[:, :3, :3]).as_quat() if len(track) else 0.0
        )
        path = folder / f'{prefix}_{name}.tum'
        path.write_text(
            ''.join(
                f'{time} {" ".join(f"{value:.12g}" for value in row)}\n'
                for time, row in zip(times, values.tolist(), strict=True)
            )
        )
        paths.append(path)
    return paths


def load_tum(folder: str | Path, prefix: str, names: Sequence[str]) -> Trajectory:
    """Read back what `save_tum` wrote. Raises TrajectoryError naming the file and line."""
    read = [_read_tum(Path(folder) / f'{prefix}_{name}.tum') for name in names]
    stamps = read[0][0]
    for name, (other, _) in zip(names, read, strict=True):
        if not np.array_equal(stamps, other):
            raise TrajectoryError(
                f'{folder}: {prefix}_{name}.tum has other stamps than {prefix}_{names[0]}.tum'
            )
    return Trajectory(stamps, tuple(names), np.stack([poses for _, poses in read], axis=1))


def _read_tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (K,) and poses (K, 4, 4) of one TUM file."""
    try:
        lines = [
            line.split()
            for line in path.read_text().splitlines()
            if line and not line.startswith('#')
        ]
    except OSError as error:
        raise TrajectoryError(f'{path}: cannot be read ({error.strerror})') from None
    try:
        stamps = np.array([_exact_stamp(fields[0]) for fields in lines], np.int64)
        values = np.array([fields[1:] for fields in lines], float).reshape(-1, 7)
        rotations = (
            Rotation.from_quat(values[:, 3:]).as_matrix() if len(values) else np.empty((0, 3, 3))
        )
    except (ValueError, IndexError) as error:
        raise TrajectoryError(
            f'{path}: every line must hold the 8 numbers `t x y z qx qy qz qw` ({error})'
        ) from None
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = values[:, :3]
    return stamps, poses


def _exact_stamp(text: str) -> int:
    """Nanoseconds of decimal seconds; a float would lose them."""
    whole, _, fraction = text.partition('.')
    return int(whole) * NANOSECONDS + int(fraction[:9].ljust(9, '0'))
