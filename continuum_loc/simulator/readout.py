"""
How frames of a real sensor reach its host.

They are not stamped at the exposure but when they are read out. A read-out that fails is made up
for with the next one: two frames then come at once and bear one stamp. Some frames come twice,
some never.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from continuum_loc.measurements import nanoseconds, TofFrame
from continuum_loc.settings import Settings
import numpy as np
from pydantic import Field


class ReadoutSettings(Settings):
    """
    What befalls the frames of one sensor.

    Shares are medians over the first half of the public flights (`continuum-loc evaluate
    flights`), whose frames come every 66 or 67 ms.
    """

    held: float = Field(
        0.043, ge=0.0, lt=1.0, description='share of frames that come with the next one'
    )
    repeated: float = Field(
        0.001, ge=0.0, lt=1.0, description='share of frames that hold what the one before held'
    )
    lost: float = Field(0.001, ge=0.0, lt=1.0, description='share of frames that never come')
    jitter: float = Field(
        0.0003, ge=0.0, description='scatter of the stamps, 1 sigma [s]; the flights keep whole ms'
    )
    rate_tolerance: float = Field(
        0.003, ge=0.0, lt=0.1, description="spread of the sensors' own rates, 1 sigma"
    )


class Readout:
    """The frames of one sensor, as they come."""

    def __init__(self, settings: ReadoutSettings, rng: np.random.Generator) -> None:
        self._settings, self._rng = settings, rng
        self._before: TofFrame | None = None
        self._waiting: TofFrame | None = None

    def take(self, frame: TofFrame) -> Iterator[TofFrame]:
        """Yield what comes when `frame` is exposed: none, it, or two of one stamp."""
        lost, repeated, held = self._rng.random(3)
        late = abs(self._settings.jitter * self._rng.standard_normal())
        if lost < self._settings.lost:
            return
        if repeated < self._settings.repeated and self._before is not None:
            frame = replace(self._before, stamp=frame.stamp)
        self._before, stamp = frame, frame.stamp + nanoseconds(late)
        if self._waiting is None and held < self._settings.held:
            self._waiting = frame
            return
        if self._waiting is not None:
            yield replace(self._waiting, stamp=stamp)
            self._waiting = None
        yield replace(frame, stamp=stamp)
