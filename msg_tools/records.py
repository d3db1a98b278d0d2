"""What a bag gives back of an earlier estimate: arrays, as recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class PosesRecord:
    """`poses` or `shape/poses`: T_map_body (N, 4, 4)."""

    stamp: int
    T_map_body: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class PathRecord:
    """`backbone` or `shape/curve`: T_map_backbone (B, 4, 4)."""

    stamp: int
    T_map_backbone: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class TipRecord:
    """
    `tip`: T_map_tip (4, 4), body velocity (6,) [v; w], and both covariances (6, 6).

    As in `Estimate`.
    """

    stamp: int
    T_map_tip: np.ndarray
    covariance: np.ndarray
    velocity: np.ndarray
    velocity_covariance: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class FrameRecord:
    """`base/frame`: T_map_frame (4, 4) of a measured base's frame, and covariance (6, 6)."""

    stamp: int
    T_map_frame: np.ndarray
    frame_covariance: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class TwistRecord:
    """`ring_twist/<ring>`: body velocity (6,) [v; w] in the ring's own frame, and (6, 6)."""

    stamp: int
    frame: str
    velocity: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class LoadRecord:
    """`load`: the strongest force on the body (3,) [N], and its moment about the map's origin."""

    stamp: int
    force: np.ndarray
    moment: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class CloudRecord:
    """
    `reconstruction` or `prior_map`: one (N,) array per field of the cloud.

    Fields are `x`, `y`, `z`, ...
    """

    stamp: int
    fields: dict[str, np.ndarray]

    @property
    def points(self) -> np.ndarray:
        """(N, 3) positions in `map`."""
        return np.column_stack([self.fields[name] for name in 'xyz']).astype(float)


@dataclass(frozen=True, slots=True)
class DiagnosticsRecord:
    """`/diagnostics`: per status its level (0 ok, 1 warning, 2 error), message and values."""

    stamp: int
    statuses: tuple[tuple[str, int, str, dict[str, str]], ...]
