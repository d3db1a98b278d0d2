"""Batch smoother, the accuracy reference: a whole recording, nothing marginalised."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from continuum_loc.estimate import Estimate
from continuum_loc.estimator.filter import SlidingWindowFilter
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.measurements import Measurement
from continuum_loc.robot import RobotDescription

ENDLESS = 1e9  # [s] a window that never marginalises


def smooth(
    robot: RobotDescription,
    prior_map,
    settings: EstimatorSettings,
    measurements: Iterable[Measurement],
    stamps: Sequence[int],
) -> list[Estimate]:
    """
    Estimates at `stamps` [ns] from all measurements at once; memory grows with the recording.

    The filter with an endless window gives the start; then everything is linearised anew until it
    converges. Raises QueryError for a stamp outside the recording.
    """
    filter_ = SlidingWindowFilter(
        robot,
        prior_map,
        settings.model_copy(update={'window': ENDLESS, 'lag': 0.0, 'history': 0.0}),
    )
    for measurement in measurements:
        filter_.process(measurement)
    filter_.flush()
    return filter_.resolve(stamps)
