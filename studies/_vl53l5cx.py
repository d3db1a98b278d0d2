"""
The `vl53l5cx` sensor model against its stated formulas, computed here a second time.

Synthetic returns of known depth and brightness: a flat wall, a step of 8 cm across every zone, and
a bright plate beside a wall that is too faint to be seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from continuum_loc.measurements import TOF_NO_TARGET, TOF_VALID
from continuum_loc.robot import load_robot, TofModel
from continuum_loc.simulator.echoes import Echoes
from continuum_loc.simulator.vl53l5cx import (
    STATUS_BLURRED,
    STATUS_INCONSISTENT,
    STATUS_NEW_TARGET,
    STATUS_WIDE_PULSE,
    Vl53l5cxReceiver,
    Vl53l5cxSettings,
)
import numpy as np

FRAMES = 300
WALL, STEP, REFLECTANCE = 1.0, 0.08, 0.8  # m, m
MILLIMETRE = 1e-3
HALVES = (-MILLIMETRE / 2.0, MILLIMETRE / 2.0)


class Bench:
    """One sensor before surfaces that are perpendicular to its optical axis."""

    def __init__(self, seed: int) -> None:
        self.model = TofModel.model_validate(
            load_robot('engine').tof_model.model_dump() | {'convention': 'perpendicular'}
        )
        self.settings = Vl53l5cxSettings()
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
        """Deviation of a pulse [m]: Table I and the floor, more for faint and for wide pulses."""
        s = self.settings
        variance = self.model.sigma(depth) ** 2 + s.noise_floor**2
        faint, wide = 1.0 + s.threshold / signal, 1.0 + (spread / s.pulse_width) ** 2
        return np.sqrt(variance * faint * wide)

    def uniform(self, measured: np.ndarray, depth: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """
        Map rounded readings to [0, 1], uniformly if they are normal (randomised transform).

        measured: (T, Z) m, nan and inf where there is no reading. depth, sigma: (Z,) of the model.
        """
        from scipy.stats import norm

        low, high = (norm.cdf((measured + half - depth) / sigma) for half in HALVES)
        spread = low + self.rng.random(measured.shape) * (high - low)
        return spread[np.isfinite(measured)]


def noise(seed: int) -> Iterator[dict[str, Any]]:
    """Rows of p-values: depth on a wall and across a step; rates of statuses."""
    from scipy import stats

    bench = Bench(seed)
    shape = bench.rays.shape[:2]
    wall, plain = np.full(shape, WALL), np.full(shape, REFLECTANCE)
    depth, status = bench.read(wall, plain)
    total = bench.signal(wall, plain).sum(axis=1)
    sigma = bench.sigma(np.full(shape[0], WALL), total, np.zeros(shape[0]))
    yield _distribution('VL53L5CX depth, wall at 1 m', bench.uniform(depth, WALL, sigma))

    s = bench.settings
    drowned, beside = _beside_a_bright_plate(bench)
    events = {
        'dropouts': (status == TOF_NO_TARGET, s.dropout),
        'inconsistent (13)': (status == STATUS_INCONSISTENT, s.inconsistent),
        'new target (10)': (
            status == STATUS_NEW_TARGET,
            s.dropout * (1.0 - s.dropout - s.inconsistent),
        ),
        'drowned by crosstalk (12)': (drowned[:, beside], 1.0 - s.dropout),
    }
    for name, (found, rate) in events.items():
        yield {
            'sensor': f'VL53L5CX {name}',
            'samples': found.size,
            'mean': found.mean(),
            'standard deviation': found.std(),
            'p_value': float(stats.binomtest(int(found.sum()), found.size, rate).pvalue),
        }
    step = _step(bench)
    measured, _ = bench.read(step, plain)
    pulse, sigma, _ = _pulse(bench, step, plain)
    yield _distribution('VL53L5CX depth, edge of 8 cm', bench.uniform(measured, pulse, sigma))


def mechanisms(seed: int) -> dict[str, float]:
    """Worst departure from whole millimetres [m]; shares of zones flagged as stated, falsely."""
    bench = Bench(seed)
    shape = bench.rays.shape[:2]
    plain = np.full(shape, REFLECTANCE)
    step = _step(bench)
    depth, status = bench.read(step, plain)
    seen = depth[np.isfinite(depth)] / MILLIMETRE
    spread = _pulse(bench, step, plain)[2]
    drowned, beside = _beside_a_bright_plate(bench)
    settled = np.isin(status, (TOF_VALID, STATUS_WIDE_PULSE))
    wide = (status == STATUS_WIDE_PULSE) == (spread > bench.settings.wide_pulse)
    return {
        'rounding': MILLIMETRE * float(np.abs(seen - np.round(seen)).max()),
        'wide': float(wide[settled].mean()),
        'falsely drowned': float(drowned[:, ~beside].mean()),
    }


def _beside_a_bright_plate(bench: Bench) -> tuple[np.ndarray, np.ndarray]:
    """
    Find status 12 (T, Z) beside a plate at 0.3 m that fills one half of the view.

    The other half meets a wall too faint to be seen. Also the zones (Z,) of that half which have
    bright neighbours.
    """
    columns = np.arange(bench.model.rows * bench.model.columns) % bench.model.columns
    half = bench.model.columns // 2
    near = np.repeat(columns[:, None] < half, bench.rays.shape[1], axis=1)
    _, status = bench.read(np.where(near, 0.3, 2.5), np.where(near, REFLECTANCE, 0.02))
    return status == STATUS_BLURRED, columns == half


def _step(bench: Bench) -> np.ndarray:
    """(Z, K) depths: in zone z the first z % (K + 1) sub-rays meet the wall, the others go on."""
    zones, sub_rays = bench.rays.shape[:2]
    near = np.arange(sub_rays) < (np.arange(zones) % (sub_rays + 1))[:, None]
    return np.where(near, WALL, WALL + STEP)


def _pulse(
    bench: Bench, depth: np.ndarray, reflectance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Centre, deviation and spread (Z,) [m] of the strongest pulse of returns (Z, K).

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
    return pulled, bench.sigma(pulled, total, spread), spread


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
