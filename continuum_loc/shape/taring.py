"""The rest at the start: averaged, judged, and made into a calibration."""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.errors import InputError, MotionError
from continuum_loc.measurements import FieldSample, ImuSample, nanoseconds
from continuum_loc.robot import RobotDescription
from continuum_loc.shape.base_motion import BaseMotion
from continuum_loc.shape.calibration import (
    calibrate,
    Calibration,
    check_wiring,
    nominal_calibration,
    PosedRest,
    straight_modules,
)
from continuum_loc.shape.estimate import described, Faults, Status
from continuum_loc.shape.faults import axis_faults, unit_faults
from continuum_loc.shape.rest import Rest, RestWindow
from continuum_loc.shape.settings import ShapeSettings
import numpy as np

UNKNOWN_YAW = np.radians(10.0)  # rad, 1 sigma, of a robot that may start bent


class Tared(NamedTuple):
    """A rest that was accepted, and what to begin with after it."""

    rest: Rest
    calibration: Calibration
    yaw_sigma: float  # [rad]


class Taring:
    """
    Averages `taring_seconds` of rest, and begins again as long as a rest is refused.

    `given` is a calibration from a file. status, message and faults tell of the last refusal.
    """

    def __init__(
        self,
        robot: RobotDescription,
        settings: ShapeSettings,
        given: Calibration | None,
        base: BaseMotion,
    ) -> None:
        self.robot, self.settings, self._given, self._base = robot, settings, given, base
        self.status: Status = 'taring'
        self.message = ''
        self.faults: Faults = {}
        self._window = RestWindow(robot)
        self._end: int | None = None

    def add(self, sample: ImuSample | FieldSample) -> Tared | None:
        """Take one sample. The one after the end of a rest gives what came of it, if accepted."""
        if self._end is None:
            self._end = sample.stamp + nanoseconds(self.settings.taring_seconds)
        if sample.stamp < self._end:
            self._window.add(sample)
            return None
        window, self._window, self._end = self._window, RestWindow(self.robot), None
        if not self._base.known:
            self.status, self.message = 'taring', 'nobody has told where the base is'
            return None
        try:
            return self._judged(window, self._base.pose(sample.stamp))
        except InputError as error:
            self.status = 'taring' if isinstance(error, MotionError) else 'faulty'
            self.message = str(error)
        return None

    @property
    def over(self) -> bool:
        """Whether the next sample begins a new rest."""
        return self._end is None

    def _judged(self, window: RestWindow, T_map_base: np.ndarray) -> Tared | None:
        """Units come first: noise in gauss looks like motion, and a field like a wrong wiring."""
        rest, straight = window.means(), self.settings.start == 'straight'
        if self._refused(unit_faults(self.robot, window)):
            return None
        window.check_motion()
        if not straight:
            return Tared(rest, self._given or nominal_calibration(self.robot), UNKNOWN_YAW)
        posed = PosedRest(rest, T_map_base, straight_modules(self.robot))
        check_wiring(self.robot, posed, self.settings.field_model)
        if self._refused(axis_faults(self.robot, posed, self.settings.field_model)):
            return None
        if self._given is not None:
            return Tared(rest, self._given, 0.0)
        return Tared(rest, calibrate(self.robot, [posed], model=self.settings.field_model), 0.0)

    def _refused(self, faults: Faults) -> bool:
        self.faults = faults
        if faults:
            self.status, self.message = 'faulty', described(faults)
        return bool(faults)
