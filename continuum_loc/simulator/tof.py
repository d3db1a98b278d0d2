"""Multizone time-of-flight sensors, cast against the scene and the robot's own body.

`paper` (Sec. IV-C): one ray per zone, Gaussian noise of Table I along the measured distance, nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from continuum_loc.measurements import TOF_NO_TARGET, TOF_VALID, TofFrame
from continuum_loc.robot import TofModel
from continuum_loc.simulator.raycast import RayCaster, cast_capsules

Fidelity = Literal["paper", "vl53l5cx"]
TOF_INCONSISTENT = 4  # the driver's status for a target that it cannot make sense of


class TofSensorModel:
    """All ToF sensors of one robot. The same generator state and poses give the same frames."""

    def __init__(self, tof_model: TofModel, caster: RayCaster, fidelity: Fidelity, rng: np.random.Generator) -> None:
        if fidelity not in ("paper", "vl53l5cx"):
            raise ValueError(f"no ToF fidelity '{fidelity}': give paper or vl53l5cx")
        self._model, self._caster, self._rng = tof_model, caster, rng
        # The raw distance times this gives the range along the zone's central ray.
        self._raw_per_range = tof_model.directions[:, 0] if tof_model.convention == "perpendicular" else 1.0

    def measure(self, T_map_sensors: np.ndarray, names: Sequence[str], stamp: int,
                body_capsules: np.ndarray | None = None) -> list[TofFrame]:
        """One frame of every sensor.

        T_map_sensors: (S, 4, 4) true sensor poses. names: S sensor names. stamp: ns. body_capsules: (M, 7), the
        robot's body as `cast_capsules` wants it; None leaves the body out of view.
        """
        if len(T_map_sensors) != len(names):
            raise ValueError(f"{len(T_map_sensors)} sensor poses but {len(names)} names")
        ranges, status = self._measure_ranges(np.asarray(T_map_sensors, dtype=float), body_capsules)
        sigma = np.where(np.isfinite(ranges), self._model.sigma(np.abs(ranges)), np.nan)
        points = np.where(np.isfinite(ranges)[..., None], ranges[..., None] * self._model.directions, np.nan)
        return [TofFrame(stamp, name, points[i], ranges[i], sigma[i], status[i]) for i, name in enumerate(names)]

    def _measure_ranges(self, T_map_sensors, body_capsules):
        """Ranges and status (S, Z) in the `paper` fidelity."""
        model = self._model
        raw = self._cast(T_map_sensors, model.directions, body_capsules) * self._raw_per_range
        noise = self._rng.standard_normal(raw.shape)  # drawn for every zone, hit or not: streams stay aligned
        hit = raw <= model.max_range
        raw = np.where(hit, raw + noise * model.sigma(np.where(hit, raw, 0.0)), np.inf)
        too_close = raw < model.min_range
        ranges = np.where(too_close, -np.inf, raw / self._raw_per_range)
        status = np.select([too_close, ~hit], [TOF_INCONSISTENT, TOF_NO_TARGET], TOF_VALID).astype(np.uint8)
        return ranges, status

    def _cast(self, T_map_sensors: np.ndarray, directions: np.ndarray, body_capsules: np.ndarray | None) -> np.ndarray:
        """True distances (S, K) along K sensor-frame unit directions of each sensor."""
        rays = directions @ T_map_sensors[:, :3, :3].transpose(0, 2, 1)
        origins = np.broadcast_to(T_map_sensors[:, None, :3, 3], rays.shape).reshape(-1, 3)
        flat = rays.reshape(-1, 3)
        distance, _, _ = self._caster.cast(origins, flat)
        if body_capsules is not None:
            distance = np.minimum(distance, cast_capsules(origins, flat, body_capsules))
        return distance.reshape(rays.shape[:2])
