"""
What a VL53L5CX makes of the light that comes back.

One perpendicular distance and a status for each zone.

A zone sees 4x4 sub-rays over its solid angle. Their light lies on a histogram of depth (distance
along the optical axis); pulses nearer than the pulse's width merge, which puts mixed readings
between two surfaces at an edge. The strongest (or nearest) pulse is reported if it is bright
enough, to the millimetre. Some of a bright zone's light leaks into its neighbours; where the leak
outshines the zone's own target, the sharpener flags it.

Signal is relative to a white, perpendicular target that fills the zone at 1 m: reflectance *
cosine / distance^2. The threshold reproduces the datasheet's reach: 4 m on white (88 %) and about
1.7 m on grey (17 %), both in the dark.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from continuum_loc.compiling import kernel
from continuum_loc.measurements import TOF_NO_TARGET, TOF_VALID
from continuum_loc.robot import TofModel
from continuum_loc.settings import Settings
from continuum_loc.simulator.echoes import Echoes, Readings, TOF_TOO_CLOSE
import numpy as np
from pydantic import Field

# Target status of the driver (see also measurements.py).
STATUS_FAINT, STATUS_FIRST, STATUS_WIDE_PULSE, STATUS_NEW_TARGET = 4, 6, 9, 10
STATUS_BLURRED, STATUS_INCONSISTENT = 12, 13
_MEASURED = (TOF_VALID, STATUS_FIRST, STATUS_WIDE_PULSE, STATUS_NEW_TARGET)

_MILLIMETRE = 1e-3


class Vl53l5cxSettings(Settings):
    """How the sensor departs from ideal."""

    sub_rays: int = Field(4, ge=1, le=16, description='sub-rays along each side of a zone')
    target_order: Literal['strongest', 'closest'] = 'strongest'
    pulse_width: float = Field(0.15, gt=0.0, description='depth within which returns merge [m]')
    threshold: float = Field(0.055, gt=0.0, description='least signal that makes a target')
    fluctuation: float = Field(0.1, ge=0.0, description='relative noise of the signal (1 sigma)')
    crosstalk: float = Field(
        0.01, ge=0.0, lt=1.0, description="share of a zone's light that reaches each neighbour"
    )
    noise_floor: float = Field(0.002, ge=0.0, description='noise beside Table I [m]')
    wide_pulse: float = Field(
        0.03, gt=0.0, description='spread of depth in a zone that earns status 9 [m]'
    )
    dropout: float = Field(
        0.002, ge=0.0, le=1.0, description='probability that a zone reports no target'
    )
    inconsistent: float = Field(0.001, ge=0.0, le=1.0, description='probability of status 13')


class Vl53l5cxReceiver:
    """
    Turns sub-ray echoes into readings.

    It remembers which zones had a target in the frame before (status 10).
    """

    def __init__(self, tof_model: TofModel, settings: Vl53l5cxSettings | None = None) -> None:
        self._model, self._settings = tof_model, settings or Vl53l5cxSettings()
        self._zone_cosine = tof_model.directions[:, 0]
        self._sub_directions = _sub_directions(tof_model, self._settings.sub_rays)
        self.directions = self._sub_directions.reshape(-1, 3)
        self._had_target: dict[str, np.ndarray] = {}

    def read(self, echoes: Echoes, names: Sequence[str], rng: np.random.Generator) -> Readings:
        """Turn echoes (S, Z * sub_rays^2) into readings (S, Z)."""
        depth, signal, spread = self._own_targets(echoes)
        depth, signal, blurred = self._leak(depth, signal)
        sigma = self._sigma(depth, signal, spread)
        normal, uniform = rng.standard_normal((2, *depth.shape)), rng.random(depth.shape)
        signal = signal * (1.0 + self._settings.fluctuation * normal[1])
        depth = np.round((depth + sigma * normal[0]) / _MILLIMETRE) * _MILLIMETRE
        status = self._status(depth, signal, spread, blurred, uniform, self._memory(names))
        self._had_target.update(zip(names, status != TOF_NO_TARGET, strict=True))
        measured = np.isin(status, _MEASURED)
        ranges = np.select(
            [measured, status == TOF_NO_TARGET, depth < self._model.min_range],
            [depth / self._zone_cosine, np.inf, -np.inf],
            np.nan,
        )
        stated = np.maximum(np.round(sigma / _MILLIMETRE), 1.0) * _MILLIMETRE / self._zone_cosine
        return Readings(ranges, np.where(measured, stated, np.nan), status)

    def _own_targets(self, echoes: Echoes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Depth, signal and spread (S, Z) of each zone's target, before crosstalk.

        Signal is 0 where there is none.
        """
        zones, sub_rays = self._sub_directions.shape[:2]
        distance = echoes.distance.reshape(-1, sub_rays)
        seen = np.isfinite(distance)
        filled = np.where(seen, distance, 1.0)
        depth = filled * np.tile(self._sub_directions[..., 0], (len(echoes.distance), 1))
        brightness = np.where(seen, echoes.brightness.reshape(-1, sub_rays), 0.0)
        signal = brightness / np.maximum(filled, 1e-3) ** 2 / sub_rays
        settings = self._settings
        targets = _targets(
            depth,
            signal,
            settings.pulse_width,
            settings.threshold,
            settings.target_order == 'closest',
        )
        return tuple(target.reshape(-1, zones) for target in targets)

    def _leak(
        self, depth: np.ndarray, signal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Depth and signal (S, Z) with the light of the brightest neighbour mixed in.

        And where it drowns the zone's own target.
        """
        shape = (len(depth), self._model.rows, self._model.columns)
        neighbour_signal, neighbour_depth = _brightest_neighbour(
            signal.reshape(shape), depth.reshape(shape)
        )
        leak = self._settings.crosstalk * neighbour_signal.reshape(depth.shape)
        leak_depth = neighbour_depth.reshape(depth.shape)
        merging = (signal > 0.0) & (np.abs(leak_depth - depth) < self._settings.pulse_width)
        drowned = ~merging & (leak > signal) & (leak > self._settings.threshold)
        share = np.where(merging, leak / np.maximum(signal + leak, 1e-30), drowned)
        return depth + share * (leak_depth - depth), np.where(drowned, leak, signal), drowned

    def _sigma(self, depth: np.ndarray, signal: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """
        Noise (S, Z) of the depth [m]: Table I and a floor.

        More for faint targets and for broadened pulses.
        """
        settings = self._settings
        base = np.hypot(self._model.sigma(depth), settings.noise_floor)
        faintness = 1.0 + settings.threshold / np.maximum(signal, settings.threshold)
        return base * np.sqrt(faintness * (1.0 + (spread / settings.pulse_width) ** 2))

    def _status(self, depth, signal, spread, blurred, uniform, before) -> np.ndarray:
        """Target status (S, Z), the gravest first."""
        settings, model = self._settings, self._model
        none = (
            (signal < settings.threshold)
            | (depth > model.max_range)
            | (uniform < settings.dropout)
        )
        inconsistent = uniform > 1.0 - settings.inconsistent
        faint = signal < 1.15 * settings.threshold
        known = before >= 0
        conditions = [
            none,
            depth < model.min_range,
            blurred,
            inconsistent,
            faint,
            ~known,
            before == 0,
            spread > settings.wide_pulse,
        ]
        statuses = [
            TOF_NO_TARGET,
            TOF_TOO_CLOSE,
            STATUS_BLURRED,
            STATUS_INCONSISTENT,
            STATUS_FAINT,
            STATUS_FIRST,
            STATUS_NEW_TARGET,
            STATUS_WIDE_PULSE,
        ]
        return np.select(conditions, statuses, TOF_VALID).astype(np.uint8)

    def _memory(self, names: Sequence[str]) -> np.ndarray:
        """
        (S, Z) int8: 1 where the zone had a target in the frame before, 0 where not.

        -1 at the first frame.
        """
        unknown = np.full(len(self._zone_cosine), -1, dtype=np.int8)
        return np.stack([self._had_target.get(name, unknown).astype(np.int8) for name in names])


def _sub_directions(model: TofModel, sub_rays: int) -> np.ndarray:
    """(Z, sub_rays^2, 3) unit rays, evenly over each zone's share of the field of view."""
    rows, columns = model.rows, model.columns
    fine = TofModel.model_validate(
        model.model_dump() | {'rows': rows * sub_rays, 'columns': columns * sub_rays}
    )
    grid = fine.directions.reshape(rows, sub_rays, columns, sub_rays, 3)
    return np.ascontiguousarray(
        grid.transpose(0, 2, 1, 3, 4).reshape(rows * columns, sub_rays**2, 3)
    )


def _brightest_neighbour(signal: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Signal and depth (S, rows, columns) of the brightest neighbour of each zone.

    There are up to eight round it.
    """
    rows, columns = signal.shape[1:]
    margin = ((0, 0), (1, 1), (1, 1))
    padded = np.pad(signal, margin), np.pad(depth, margin)
    shifts = [
        (slice(r, r + rows), slice(c, c + columns))
        for r in range(3)
        for c in range(3)
        if (r, c) != (1, 1)
    ]
    around = [np.stack([grid[:, down, across] for down, across in shifts]) for grid in padded]
    brightest = np.argmax(around[0], axis=0)[None]
    return tuple(np.take_along_axis(grid, brightest, axis=0)[0] for grid in around)


@kernel
def _targets(depth, signal, width, threshold, closest):
    """
    Depth, signal and spread (N,) of the reported pulse among K returns (N, K) of each zone.

    A pulse is centred on a return and gathers its neighbours in depth with weight (1 - (dz /
    width)^2)^2.
    """
    count, returns = depth.shape
    best_depth, best_signal, best_spread = np.zeros(count), np.zeros(count), np.zeros(count)
    for i in range(count):
        nearest = np.inf
        if closest:
            for j in range(returns):
                if (
                    depth[i, j] < nearest
                    and _gather(depth[i], signal[i], depth[i, j], width)[0] >= threshold
                ):
                    nearest = depth[i, j]
        for j in range(returns):
            if signal[i, j] <= 0.0 or depth[i, j] > nearest + width:
                continue
            total, mean, spread = _gather(depth[i], signal[i], depth[i, j], width)
            if total > best_signal[i]:
                best_signal[i], best_depth[i], best_spread[i] = total, mean, spread
    return best_depth, best_signal, best_spread


@kernel
def _gather(depth, signal, centre, width):
    """Total, mean and standard deviation of the returns within `width` of a depth, weighted."""
    total, first, second = 0.0, 0.0, 0.0
    for j in range(len(depth)):
        offset = depth[j] - centre
        inside = 1.0 - (offset / width) ** 2
        if inside > 0.0:
            weight = signal[j] * inside * inside
            total += weight
            first += weight * offset
            second += weight * offset * offset
    if total <= 0.0:
        return 0.0, centre, 0.0
    mean = first / total
    return total, centre + mean, np.sqrt(max(second / total - mean * mean, 0.0))
