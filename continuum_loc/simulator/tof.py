"""
Multizone time-of-flight sensors, cast against the scene and the robot's own body.

Two fidelities: `paper` (Sec. IV-C), one ray per zone with Gaussian noise of Table I along the
measured distance; and `vl53l5cx`, which also reproduces what the real sensor does (see
`vl53l5cx.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args, Literal, TYPE_CHECKING

from continuum_loc.measurements import TOF_NO_TARGET, TOF_VALID, TofFrame
from continuum_loc.robot import TofModel
from continuum_loc.simulator.echoes import Echoes, Readings, Receiver, TOF_TOO_CLOSE
from continuum_loc.simulator.raycast import cast_capsules, RayCaster
import numpy as np

if TYPE_CHECKING:
    from continuum_loc.simulator.vl53l5cx_settings import Vl53l5cxSettings

Fidelity = Literal['paper', 'vl53l5cx']

# The body's black plastic, and the mean cosine at which rays meet a cylinder seen broadside.
_BODY_REFLECTANCE = 0.3 * np.pi / 4.0


class TofSensorModel:
    """
    All ToF sensors of one robot. The same generator state and poses give the same frames.

    settings: how a VL53L5CX departs from ideal (fidelity `vl53l5cx` alone; None takes the usual
    ones).
    """

    def __init__(
        self,
        tof_model: TofModel,
        caster: RayCaster,
        fidelity: Fidelity,
        rng: np.random.Generator,
        settings: Vl53l5cxSettings | None = None,
    ) -> None:
        self._zones, self._caster, self._rng = tof_model.directions, caster, rng
        self._receiver = _receiver(tof_model, fidelity, settings)

    def measure(
        self,
        T_map_sensors: np.ndarray,
        names: Sequence[str],
        stamp: int,
        body_capsules: np.ndarray | None = None,
    ) -> list[TofFrame]:
        """
        One frame of every sensor.

        T_map_sensors: (S, 4, 4) true sensor poses. names: S sensor names. stamp: ns.
        body_capsules: (M, 7), the robot's body as `cast_capsules` wants it; None leaves the body
        out of view.
        """
        readings = self.read(T_map_sensors, names, body_capsules)
        finite = np.isfinite(readings.ranges)[..., None]
        points = np.where(finite, readings.ranges[..., None] * self._zones, np.nan)
        return [
            TofFrame(
                stamp, name, points[i], readings.ranges[i], readings.sigma[i], readings.status[i]
            )
            for i, name in enumerate(names)
        ]

    def read(
        self,
        T_map_sensors: np.ndarray,
        names: Sequence[str],
        body_capsules: np.ndarray | None = None,
    ) -> Readings:
        """Read every sensor once, before frames are made of it; arguments as of `measure`."""
        if np.shape(T_map_sensors) != (len(names), 4, 4):
            raise ValueError(
                f'sensor poses {np.shape(T_map_sensors)} do not fit {len(names)} names'
            )
        echoes = self._cast(np.asarray(T_map_sensors, dtype=float), body_capsules)
        return self._receiver.read(echoes, names, self._rng)

    def _cast(self, T_map_sensors: np.ndarray, body_capsules: np.ndarray | None) -> Echoes:
        rays = self._receiver.directions @ T_map_sensors[:, :3, :3].transpose(0, 2, 1)
        origins = np.ascontiguousarray(T_map_sensors[:, :3, 3])
        light = self._caster.cast_light(
            np.repeat(origins, rays.shape[1], axis=0), rays.reshape(-1, 3)
        )
        distance, brightness = (part.reshape(rays.shape[:2]) for part in light)
        if body_capsules is None:
            return Echoes(distance, brightness)
        body = cast_capsules(
            origins, np.ascontiguousarray(rays), np.ascontiguousarray(body_capsules, dtype=float)
        )
        hidden = body < distance
        return Echoes(
            np.where(hidden, body, distance), np.where(hidden, _BODY_REFLECTANCE, brightness)
        )


class PaperReceiver:
    """
    One ray per zone.

    Noise: N(0, sigma(d)) of Table I on the raw distance d, along the ray or along the optical axis
    as the model's convention has it.
    """

    def __init__(self, tof_model: TofModel) -> None:
        self.directions = tof_model.directions
        self._model = tof_model
        self._raw_per_range = (
            self.directions[:, 0] if tof_model.convention == 'perpendicular' else 1.0
        )

    def read(self, echoes: Echoes, names: Sequence[str], rng: np.random.Generator) -> Readings:
        """Turn echoes (S, Z) into readings (S, Z)."""
        model, raw = self._model, echoes.distance * self._raw_per_range
        # For every zone, hit or not: the stream stays aligned.
        noise = rng.standard_normal(raw.shape)
        hit = raw <= model.max_range
        measured = np.where(hit, raw, 0.0) + noise * model.sigma(np.where(hit, raw, 0.0))
        too_close = hit & (measured < model.min_range)
        ranges = np.select([~hit, too_close], [np.inf, -np.inf], measured / self._raw_per_range)
        sigma = np.where(np.isfinite(ranges), model.sigma(measured) / self._raw_per_range, np.nan)
        status = np.select([~hit, too_close], [TOF_NO_TARGET, TOF_TOO_CLOSE], TOF_VALID).astype(
            np.uint8
        )
        return Readings(ranges, sigma, status)


def _receiver(tof_model: TofModel, fidelity: str, settings: Vl53l5cxSettings | None) -> Receiver:
    if fidelity == 'paper' and settings is None:
        return PaperReceiver(tof_model)
    if fidelity == 'vl53l5cx':
        from continuum_loc.simulator.vl53l5cx import Vl53l5cxReceiver

        return Vl53l5cxReceiver(tof_model, settings)
    if fidelity == 'paper':
        raise ValueError("ToF fidelity 'paper' takes no settings of a VL53L5CX")
    raise ValueError(f"no ToF fidelity '{fidelity}': give {' or '.join(get_args(Fidelity))}")
