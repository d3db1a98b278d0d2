"""What the filter tells the world after a step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Status = Literal['initialising', 'tracking', 'doubtful', 'lost']


@dataclass(frozen=True, slots=True, eq=False)
class PointLoad:
    """
    A force on the body that its tendons and its weight do not explain.

    s: arclength [m], and its standard deviation `s_sigma`. force (3,) [N] in the map, at `place`
    (3,), with covariance (3, 3).
    """

    s: float
    s_sigma: float
    place: np.ndarray
    force: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """
    The body at one instant.

    Its base and R rings (in the robot description's order), and its backbone.

    stamp: integer ns of the instant.
    T_map_ring: (R + 1, 4, 4) poses, the base first.
    covariance: (R + 1, 6, 6) of a right perturbation, [rho; phi] order (m, rad), in the ring's own
    frame.
    strain, velocity: (R + 1, 6) body-frame generalised strain [nu; omega] and velocity [v; w].
    velocity_covariance: (R + 1, 6, 6).
    backbone_s: (B,) arclengths, evenly spaced; T_map_backbone: (B, 4, 4).
    status: `initialising` until the first consistent fit, `tracking` while all is well, `doubtful`
    while the measurements contradict the description or one another, or `lost`.
    doubts: why the status is `doubtful`, in words.
    consistency: mean normalised innovation squared per measured dimension in the window (1 when
    honest).
    inliers: share of usable zones that fit the map, by ToF sensor.
    suspects: why a sensor is not to be believed, by name.
    T_map_frame: (4, 4) pose of the frame in which a carried base is measured, `map -> odom` where
    that is odometry; None where the base is not measured. frame_covariance: (6, 6) of it.
    loads: what the body touches, where shape and tendons tell; strongest evidence first.
    lagged: the same body at `stamp - lag`, smoothed by everything since; None before there is one.
    """

    stamp: int
    T_map_ring: np.ndarray
    covariance: np.ndarray
    strain: np.ndarray
    velocity: np.ndarray
    velocity_covariance: np.ndarray
    backbone_s: np.ndarray
    T_map_backbone: np.ndarray
    status: Status
    consistency: float
    inliers: dict[str, float] = field(default_factory=dict)
    suspects: dict[str, str] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
    iterations: int = 0
    converged: bool = True
    step_seconds: float = 0.0
    lagged: Estimate | None = None
    T_map_frame: np.ndarray | None = None
    frame_covariance: np.ndarray | None = None
    loads: tuple[PointLoad, ...] = ()

    @property
    def least_known(self) -> tuple[int, float, np.ndarray]:
        """
        Find the direction in which a position is known least.

        Returns the index of the ring, the standard deviation there [m] and the unit vector (3,)
        in the map. Large where no measurement observes it: along a smooth pipe, say.
        """
        R = self.T_map_ring[:, :3, :3]
        variances, axes = np.linalg.eigh(R @ self.covariance[:, :3, :3] @ R.swapaxes(1, 2))
        ring = int(np.argmax(variances[:, 2]))
        return ring, float(np.sqrt(max(variances[ring, 2], 0.0))), axes[ring, :, 2]
