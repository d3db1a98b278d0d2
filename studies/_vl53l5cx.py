"""
The `vl53l5cx` sensor model against its stated formulas, computed here a second time.

Synthetic returns of known depth and brightness: a flat wall, a step of 20 cm across every zone,
and no return at all. Only what a test is not about is switched off.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from continuum_loc.measurements import TOF_VALID
from continuum_loc.robot import load_robot, TofModel
from continuum_loc.simulator.tof import Echoes
from continuum_loc.simulator.vl53l5cx import (
    AMBIENT_UNIT,
    STATUS_FAINT,
    STATUS_NEW_TARGET,
    STATUS_STRAY,
    STATUS_WIDE_PULSE,
    Vl53l5cxReceiver,
    Vl53l5cxSettings,
)
import numpy as np

FRAMES = 300
WALL, STEP, REFLECTANCE = 1.0, 0.2, 0.8  # m, m
UNITS = 400
MILLIMETRE = 1e-3
HALVES = (-MILLIMETRE / 2.0, MILLIMETRE / 2.0)


class Bench:
    """One sensor before surfaces that are perpendicular to its optical axis."""

    def __init__(self, seed: int) -> None:
        self.model = TofModel.model_validate(
            load_robot('engine').tof_model.model_dump() | {'convention': 'perpendicular'}
        )
        same = dict.fromkeys(('range_offset', 'range_scale', 'warm_up', 'pattern'), 0.0)
        self.settings = Vl53l5cxSettings(fluctuation=0.0, **same)
        self.rng = np.random.default_rng(seed)
        rays = Vl53l5cxReceiver(self.model).directions
        self.rays = rays.reshape(self.model.rows * self.model.columns, -1, 3)  # (Z, K, 3)

    def read(
        self, depth: np.ndarray, reflectance: np.ndarray, frames: int = FRAMES
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depths [m] and statuses (T, Z) of frames after the first, of returns (Z, K)."""
        receiver = Vl53l5cxReceiver(self.model, self.settings)
        cosine = self.rays[..., 0]
        echoes = Echoes((depth / cosine).reshape(1, -1), (reflectance * cosine).reshape(1, -1))
        readings = [receiver.read(echoes, ('tof',), self.rng) for _ in range(frames + 1)][1:]
        ranges = np.concatenate([reading.ranges for reading in readings])
        status = np.concatenate([reading.status for reading in readings])
        return ranges * self.model.directions[:, 0], status

    def signal(self, depth: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
        """(Z, K) light of each return: reflectance x cosine / distance squared, over K."""
        cosine = self.rays[..., 0]
        return reflectance * cosine / (depth / cosine) ** 2 / self.rays.shape[1]

    def sigma(self, depth: np.ndarray, signal: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Deviation of a pulse's core [m]: a table, more for faint and for wide pulses."""
        s = self.settings
        core = np.interp(depth, s.noise_distance, s.noise)
        wide = 1.0 + (spread / s.pulse_width) ** 2
        return core * np.sqrt((1.0 + s.faint_noise * self.faintness(signal)) * wide)

    def faintness(self, signal: np.ndarray) -> np.ndarray:
        """Threshold in the ambient light over signal; all signals here are above it."""
        lit = self.settings.threshold * np.sqrt(1.0 + self.settings.ambient / AMBIENT_UNIT)
        return lit / signal

    def uniform(
        self, measured: np.ndarray, depth: np.ndarray, signal: np.ndarray, spread: np.ndarray
    ) -> np.ndarray:
        """
        Map rounded readings to [0, 1], uniformly if they are as modelled (randomised transform).

        measured: (T, Z) m, nan and inf where there is no reading. depth, signal, spread: (Z,) of
        the model, a normal core and wider normal tails.
        """
        from scipy.stats import norm

        core, tails = (
            self.sigma(depth, signal, spread),
            self.settings.tail * self.faintness(signal),
        )
        wide = self.settings.tail_size * self.model.sigma(depth)
        low, high = (
            (1.0 - tails) * norm.cdf((measured + half - depth) / core)
            + tails * norm.cdf((measured + half - depth) / wide)
            for half in HALVES
        )
        between = low + self.rng.random(measured.shape) * (high - low)
        return between[np.isfinite(measured)]


def noise(seed: int) -> Iterator[dict[str, Any]]:
    """Rows of p-values: depth on a wall and across a step; rates of statuses; units."""
    bench = Bench(seed)
    shape = bench.rays.shape[:2]
    wall, plain = np.full(shape, WALL), np.full(shape, REFLECTANCE)
    depth, status = bench.read(wall, plain)
    total, even = bench.signal(wall, plain).sum(axis=1), np.zeros(shape[0])
    uniform = bench.uniform(depth, np.full(shape[0], WALL), total, even)
    yield _distribution('VL53L5CX depth, wall at 1 m', uniform)
    step = _step(bench)
    measured, _ = bench.read(step, plain)
    pulse = _pulse(bench, step, plain)
    yield _distribution('VL53L5CX depth, edge of 20 cm', bench.uniform(measured, *pulse))
    s = bench.settings
    yield _rate('dropouts', ~np.isin(status, (5, 9, 10)), s.dropout)
    yield _rate(
        'new target (10)',
        status == STATUS_NEW_TARGET,
        s.dropout * (1.0 - s.dropout) * s.new_target,
    )
    _, empty = bench.read(np.full(shape, np.inf), plain)
    stray = empty == STATUS_STRAY
    yield _rate('stray (2) begins', stray[1:][~stray[:-1]], s.stray)
    yield _rate('faint (4)', (empty == STATUS_FAINT)[~stray], s.faint)
    yield _distribution('VL53L5CX offset and scale of units', _units(bench))


def _rate(name: str, found: np.ndarray, rate: float) -> dict[str, Any]:
    """Row of a binomial test."""
    from scipy import stats

    return {
        'sensor': f'VL53L5CX {name}',
        'samples': found.size,
        'mean': found.mean(),
        'standard deviation': found.std(),
        'p_value': float(stats.binomtest(int(found.sum()), found.size, rate).pvalue),
    }


def _units(bench: Bench) -> np.ndarray:
    """Integral transform (UNITS,) of what units of the usual spread read of the wall."""
    from scipy.stats import norm

    s = Vl53l5cxSettings(fluctuation=0.0, tail=0.0, dropout=0.0, pattern=0.0)
    receiver = Vl53l5cxReceiver(bench.model, s)
    cosine = bench.rays[..., 0].reshape(1, -1)
    echoes = Echoes(
        np.repeat(WALL / cosine, UNITS, axis=0), np.repeat(REFLECTANCE * cosine, UNITS, axis=0)
    )
    read = receiver.read(echoes, [f'unit{k}' for k in range(UNITS)], bench.rng).raw
    signal = REFLECTANCE / WALL**2
    averaged = bench.sigma(np.array(WALL), np.array(signal), np.array(0.0)) / np.sqrt(
        read.shape[1]
    )
    spread = np.sqrt(s.range_offset**2 + (s.range_scale * WALL) ** 2 + s.warm_up**2 + averaged**2)
    return norm.cdf((read.mean(axis=1) - WALL) / spread)


def mechanisms(seed: int) -> dict[str, float]:
    """Worst departure from whole millimetres [m]; share of zones flagged as stated."""
    bench = Bench(seed)
    shape = bench.rays.shape[:2]
    plain = np.full(shape, REFLECTANCE)
    step = _step(bench)
    depth, status = bench.read(step, plain)
    seen = depth[np.isfinite(depth)] / MILLIMETRE
    spread = _pulse(bench, step, plain)[2]
    settled = np.isin(status, (TOF_VALID, STATUS_WIDE_PULSE))
    wide = (status == STATUS_WIDE_PULSE) == (spread > bench.settings.wide_pulse)
    return {
        'rounding': MILLIMETRE * float(np.abs(seen - np.round(seen)).max()),
        'wide': float(wide[settled].mean()),
    }


def _step(bench: Bench) -> np.ndarray:
    """(Z, K) depths: in zone z the first z % (K + 1) sub-rays meet the wall, the others go on."""
    zones, sub_rays = bench.rays.shape[:2]
    near = np.arange(sub_rays) < (np.arange(zones) % (sub_rays + 1))[:, None]
    return np.where(near, WALL, WALL + STEP)


def _pulse(
    bench: Bench, depth: np.ndarray, reflectance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Centre [m], signal and spread [m] (Z,) of the strongest pulse of returns (Z, K).

    A pulse is centred on a return and weighs the others with (1 - (dz / width)^2)^2; the light of
    the brightest neighbour, 1 % of it, then pulls the centre.
    """
    signal = bench.signal(depth, reflectance)
    offset = depth[:, None, :] - depth[:, :, None]  # [z, centre, other]
    weight = np.clip(1.0 - (offset / bench.settings.pulse_width) ** 2, 0.0, None) ** 2
    light = signal[:, None, :] * weight
    strongest = np.argmax(light.sum(axis=2), axis=1)
    light = np.take_along_axis(light, strongest[:, None, None], axis=1)[:, 0]
    total = light.sum(axis=1)
    centre = (light * depth).sum(axis=1) / total
    spread = np.sqrt((light * (depth - centre[:, None]) ** 2).sum(axis=1) / total)
    pulled = _crosstalk(bench, centre, total)
    return pulled, total, spread


def _crosstalk(bench: Bench, centre: np.ndarray, total: np.ndarray) -> np.ndarray:
    """(Z,) centres pulled towards each zone's brightest neighbour, zone by zone."""
    columns = bench.model.columns
    pulled = centre.copy()
    for zone in range(len(centre)):
        row, column = divmod(zone, columns)
        around = [
            other
            for other in range(len(centre))
            if other != zone
            and max(abs(other // columns - row), abs(other % columns - column)) == 1
        ]
        brightest = around[int(np.argmax(total[around]))]
        leak = bench.settings.crosstalk * total[brightest]
        share = leak / (total[zone] + leak)
        pulled[zone] += share * (centre[brightest] - centre[zone])
    return pulled


def _distribution(name: str, uniform: np.ndarray) -> dict[str, Any]:
    """Row of a Kolmogorov-Smirnov test of integral transforms against the uniform law."""
    from scipy import stats

    z = stats.norm.ppf(np.clip(uniform, 1e-12, 1.0 - 1e-12))
    return {
        'sensor': name,
        'samples': uniform.size,
        'mean': z.mean(),
        'standard deviation': z.std(),
        'p_value': float(stats.kstest(uniform, 'uniform').pvalue),
    }
