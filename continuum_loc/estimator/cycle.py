"""
When a step of the filter is due: ToF sensors that speak in turn set the pace.

A cycle begins with a measurement and is complete once every sensor of the last one has spoken; it
waits for silent ones for `PATIENCE` of their periods. Without a factor that sets the pace the
clock does.
"""

from __future__ import annotations

from collections.abc import Sequence

from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.state import TIME_EPSILON
from continuum_loc.measurements import Measurement, seconds

PATIENCE = 1.5  # periods that a cycle waits for silent sensors


class Cycle:
    """
    The running cycle, and the stamp of what was put out last.

    output_rate: [Hz] where none of the factors sets the pace.
    """

    def __init__(self, factors: Sequence[Factor], output_rate: float):
        self._pace = next((factor for factor in factors if factor.rate > 0.0), None)
        self._longest = PATIENCE / self._pace.rate if self._pace else 1.0 / output_rate
        self._heard: set[str] = set()
        self._last: set[str] = set()
        self._start: int | None = None
        self._stamp = 0
        self.output = 0

    @property
    def running(self) -> bool:
        return self._start is not None

    def over(self, measurement: Measurement) -> bool:
        """Whether a cycle that began can wait no longer for the sensors that are missing in it."""
        if self._start is None or measurement.stamp <= self._start:
            return False
        again = self._paces(measurement) and measurement.sensor in self._heard
        return again or seconds(measurement.stamp, self._start) >= self._longest - TIME_EPSILON

    def complete(self, measurement: Measurement) -> bool:
        """Note a measurement; True when every sensor of the last cycle has spoken."""
        self._start = self._start or measurement.stamp
        if not self._paces(measurement):
            return False
        if not self._heard and measurement.stamp <= self.output:
            # A straggler of what was put out begins no cycle, which would be split as that one
            # was and lack its sensors for ever; the next one waits for it.
            self._last.add(measurement.sensor)
            return False
        self._heard.add(measurement.sensor)
        self._stamp = max(self._stamp, measurement.stamp)
        everybody = len(self._heard) == len(self._pace.sensors)
        return everybody or bool(self._last) and self._heard >= self._last

    def finish(self, newest: int) -> int:
        """
        End the cycle; the stamp [ns] to put out, `newest` where nothing came that sets the pace.

        What sets the pace sets the time: a clock that runs ahead of its must not.
        """
        self.output = max(self._stamp if self._heard else newest, self.output)
        self._last, self._heard, self._start = self._heard, set(), None
        return self.output

    def _paces(self, measurement: Measurement) -> bool:
        return self._pace is not None and isinstance(measurement, self._pace.consumes)
