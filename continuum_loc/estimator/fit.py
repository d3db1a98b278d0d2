"""How the measurements in a window fit: sums of what the factors report of its intervals."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.interval import Interval
import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Sum of squares, number of measured dimensions, and share of fitting samples by sensor."""

    squared: float
    count: int
    shares: dict[str, float]


def fit_of(intervals: Sequence[Interval]) -> Fit:
    """How the measurements in some intervals fit."""
    squared, count = 0.0, 0
    for interval in intervals:
        for report in interval.reports.values():
            squared += report.squared
            count += report.count
    samples = _sums(intervals, 'fits')
    return Fit(
        squared, count, {name: float(fit[1] / fit[0]) for name, fit in samples.items() if fit[0]}
    )


def misfit_by_factor(intervals: Sequence[Interval]) -> dict[str, float]:
    """Mean squared normalised residual of each factor's measurements."""
    sums: dict[str, np.ndarray] = {}
    for interval in intervals:
        for factor, report in interval.reports.items():
            part = np.array([report.squared, report.count])
            sums[factor.name] = sums.get(factor.name, 0.0) + part
    return {name: float(squared / max(count, 1)) for name, (squared, count) in sums.items()}


def share_by_factor(intervals: Sequence[Interval]) -> dict[str, float]:
    """Share of fitting samples, of those factors that tell it and had any."""
    sums: dict[str, np.ndarray] = {}
    for interval in intervals:
        for factor, report in interval.reports.items():
            if report.fits is not None and len(report.fits):
                sums[factor.name] = sums.get(factor.name, 0.0) + report.fits.sum(axis=0)
    return {name: float(fit / usable) for name, (usable, fit) in sums.items() if usable}


def consistency(intervals: Sequence[Interval], without: Collection[str] = ()) -> float:
    """Mean squared normalised residual of all factors but some; 1 where the noise is as stated."""
    squared, count = 0.0, 0
    for interval in intervals:
        for factor, report in interval.reports.items():
            if factor.name not in without:
                squared += report.squared
                count += report.count
    return squared / max(count, 1)


def newest_fits(intervals: Sequence[Interval], factor: Factor) -> dict[str, np.ndarray]:
    """[usable, fitting] samples by sensor, in the newest interval that has this factor."""
    for interval in reversed(intervals):
        if factor in interval.reports:
            return dict(zip(factor.sensors, interval.reports[factor].fits, strict=True))
    return {}


def measurement_cost(intervals: Sequence[Interval]) -> float:
    """Robust cost of the measurements alone, without the priors."""
    return sum(report.cost for interval in intervals for report in interval.reports.values())


def flicker(intervals: Sequence[Interval]) -> dict[str, float]:
    """Share of each ToF sensor's zones that the map matched in one of two frames in a row."""
    counts = _sums(intervals, 'flicker')
    return {name: float(changed / seen) for name, (seen, changed) in counts.items() if seen}


def rattle(intervals: Sequence[Interval]) -> dict[str, np.ndarray]:
    """Largest variance (3,) by gyro of the turns that are too fast for the knots [rad^2]."""
    found: dict[str, np.ndarray] = {}
    for interval in intervals:
        for factor, report in interval.reports.items():
            if report.rattle is None:
                continue
            for name, variance in zip(factor.sensors, report.rattle, strict=True):
                if np.isfinite(variance[0]):
                    found[name] = np.maximum(found.get(name, 0.0), variance)
    return found


def _sums(intervals: Sequence[Interval], what: str) -> dict[str, np.ndarray]:
    """Sum by sensor of a part of the reports."""
    sums: dict[Factor, np.ndarray] = {}
    for interval in intervals:
        for factor, report in interval.reports.items():
            part = getattr(report, what)
            if part is not None:
                sums[factor] = sums.get(factor, 0.0) + part
    return {
        name: total
        for factor, totals in sums.items()
        for name, total in zip(factor.sensors, totals, strict=True)
    }
