"""
What a VL53L5CX makes of the light that comes back: a distance and a status for each zone.

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

from continuum_loc.compiling import kernel
from continuum_loc.measurements import TOF_NO_TARGET, TOF_VALID
from continuum_loc.robot import TofModel
from continuum_loc.simulator.echoes import Echoes, Readings
from continuum_loc.simulator.vl53l5cx_settings import Vl53l5cxSettings
from continuum_loc.simulator.vl53l5cx_unit import Units
import numpy as np

# Target status of the driver (see also measurements.py). Public flights in a room never show 6, 12
# or 13: a recording begins while the sensor ranges already, and what the sharpener takes out
# leaves no target.
STATUS_STRAY, STATUS_FAINT, STATUS_WIDE_PULSE, STATUS_NEW_TARGET = 2, 4, 9, 10
STATUS_INCONSISTENT = 13

_MILLIMETRE = 1e-3
_FORGETS = 0.05  # share of the way to 1 m that a distance in the registers goes each frame


class Vl53l5cxReceiver:
    """Turns sub-ray echoes into readings; `vl53l5cx_unit.Units` are what it remembers."""

    def __init__(self, tof_model: TofModel, settings: Vl53l5cxSettings | None = None) -> None:
        self._model, self._settings = tof_model, settings or Vl53l5cxSettings()
        self._zone_cosine = tof_model.directions[:, 0]
        self._sub_directions = _sub_directions(tof_model, self._settings.sub_rays)
        self.directions = self._sub_directions.reshape(-1, 3)
        self._units: dict[str, Units] = {}

    def read(self, echoes: Echoes, names: Sequence[str], rng: np.random.Generator) -> Readings:
        """Turn echoes (S, Z * sub_rays^2) into readings (S, Z)."""
        settings, units = self._settings, self._recall(names, rng)
        depth, signal, spread = self._own_targets(echoes)
        depth, signal = self._leak(depth, signal)
        normal, uniform = rng.standard_normal((3, *depth.shape)), rng.random((6, *depth.shape))
        sigma, faintness = self._sigma(depth, signal, spread), self._faintness(signal)
        tail = uniform[0] < settings.tail * faintness
        error = np.where(tail, settings.tail_size * self._model.sigma(depth), sigma) * normal[0]
        seconds = units.frames / self._model.rate
        raw = _whole(units.biased(depth, seconds, settings.warm_up_time) + error)
        units.fade(settings.persistence, normal[1])
        signal = signal * np.exp(settings.fluctuation * units.fading)
        status = self._status(depth, signal, spread, uniform, units)
        raw = np.where(
            (status == TOF_NO_TARGET) & ((depth <= 0.0) | (depth >= settings.near)),
            np.maximum(0.0, _whole(units.register + error)),
            raw,
        )
        raw = _registered(raw, status, units, uniform[5])
        self._remember(names, units, status, raw)
        ranges = np.where(_measured(status), raw / self._zone_cosine, np.nan)
        ranges[_measured(status) & (raw < self._model.min_range)] = -np.inf
        ranges[status == TOF_NO_TARGET] = np.inf
        stated = np.maximum(np.round(sigma / _MILLIMETRE), 1.0) * _MILLIMETRE / self._zone_cosine
        return Readings(ranges, np.where(np.isfinite(ranges), stated, np.nan), status, raw)

    def _recall(self, names: Sequence[str], rng: np.random.Generator) -> Units:
        for name in names:
            if name not in self._units:
                self._units[name] = Units.drawn(1, len(self._zone_cosine), self._settings, rng)
        return Units.together([self._units[name] for name in names])

    def _remember(
        self, names: Sequence[str], units: Units, status: np.ndarray, raw: np.ndarray
    ) -> None:
        units.seen = _measured(status) | (status == STATUS_NEW_TARGET)
        units.stray = status == STATUS_STRAY
        units.register = np.where(units.seen, raw, units.register)
        units.forget(_FORGETS)
        units.frames = units.frames + 1
        self._units.update(zip(names, units.apart(), strict=True))

    def _own_targets(self, echoes: Echoes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, signal (0: none) and spread (S, Z) of each zone's target, before crosstalk."""
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
            settings.lit_threshold,
            settings.target_order == 'closest',
        )
        return tuple(target.reshape(-1, zones) for target in targets)

    def _leak(self, depth: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Depth and signal (S, Z) with the light of the brightest neighbour mixed in.

        Where the leak outshines the zone's own target, the sharpener takes it out: no target.
        """
        shape = (len(depth), self._model.rows, self._model.columns)
        neighbour_signal, neighbour_depth = _brightest_neighbour(
            signal.reshape(shape), depth.reshape(shape)
        )
        leak = self._settings.crosstalk * neighbour_signal.reshape(depth.shape)
        leak_depth = neighbour_depth.reshape(depth.shape)
        merging = (signal > 0.0) & (np.abs(leak_depth - depth) < self._settings.pulse_width)
        drowned = ~merging & (leak > signal) & (leak > self._settings.threshold)
        share = np.where(merging, leak / np.maximum(signal + leak, 1e-30), 0.0)
        return depth + share * (leak_depth - depth), np.where(drowned, 0.0, signal)

    def _sigma(self, depth: np.ndarray, signal: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Core of the noise (S, Z) of the depth [m]: more for faint targets and wide pulses."""
        settings = self._settings
        base = np.interp(depth, settings.noise_distance, settings.noise)
        broadening = 1.0 + (spread / settings.pulse_width) ** 2
        return base * np.sqrt((1.0 + settings.faint_noise * self._faintness(signal)) * broadening)

    def _faintness(self, signal: np.ndarray) -> np.ndarray:
        """(S, Z): 1 for a target that is hardly seen, towards 0 for a bright one."""
        threshold = self._settings.lit_threshold
        return threshold / np.maximum(signal, threshold)

    def _status(
        self,
        depth: np.ndarray,
        signal: np.ndarray,
        spread: np.ndarray,
        uniform: np.ndarray,
        units: Units,
    ) -> np.ndarray:
        """Target status (S, Z), the gravest last; uniform (6, S, Z) decides what is chance."""
        settings = self._settings
        none = (
            (signal < settings.lit_threshold)
            | (depth > self._model.max_range)
            | (uniform[1] < settings.dropout)
            | ((depth < settings.near) & units.blind)
        )
        goes_on = np.where(units.stray, settings.stray_stays, settings.stray)
        status = np.full(depth.shape, TOF_VALID, np.uint8)
        for code, condition in (
            (STATUS_WIDE_PULSE, spread > settings.wide_pulse),
            (STATUS_NEW_TARGET, ~units.seen & (uniform[4] < settings.new_target)),
            (STATUS_INCONSISTENT, uniform[3] < settings.inconsistent),
            (TOF_NO_TARGET, none),
            (STATUS_FAINT, none & (uniform[3] < settings.faint)),
            (STATUS_STRAY, none & (uniform[2] < goes_on)),
        ):
            status[condition] = code
        return status


def _measured(status: np.ndarray) -> np.ndarray:
    """Whether a status comes with a distance that means something."""
    return (status == TOF_VALID) | (status == STATUS_WIDE_PULSE)


def _whole(depth: np.ndarray) -> np.ndarray:
    """Round to the millimetre."""
    return np.round(depth / _MILLIMETRE) * _MILLIMETRE


def _registered(
    raw: np.ndarray, status: np.ndarray, units: Units, uniform: np.ndarray
) -> np.ndarray:
    """
    Distance (S, Z) [m] in the driver's registers, of which `raw` is right where a target is.

    With status 2 it is 0 or beyond 3.5 m, with status 4 often the last one or far away.
    """
    far = _whole(3.5 + 0.8 * uniform)
    stray, faint = np.where(uniform < 0.24, 0.0, far), np.where(uniform < 0.3, far, units.register)
    return np.where(status == STATUS_STRAY, stray, np.where(status == STATUS_FAINT, faint, raw))


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


@kernel
def _brightest_neighbour(signal, depth):
    """
    Signal and depth (S, rows, columns) of the brightest neighbour of each zone.

    There are up to eight round it; beyond the grid there is no light.
    """
    sensors, rows, columns = signal.shape
    best_signal, best_depth = np.full(signal.shape, -1.0), np.zeros(signal.shape)
    for s in range(sensors):
        for i in range(rows):
            for j in range(columns):
                for neighbour in range(9):
                    row, column = i + neighbour // 3 - 1, j + neighbour % 3 - 1
                    light, distance = 0.0, 0.0
                    if 0 <= row < rows and 0 <= column < columns:
                        light, distance = signal[s, row, column], depth[s, row, column]
                    if neighbour != 4 and light > best_signal[s, i, j]:
                        best_signal[s, i, j], best_depth[s, i, j] = light, distance
    return best_signal, best_depth


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
