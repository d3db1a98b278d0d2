"""
What contradicts the description: told in words, and whether the estimate is to be believed.

Three questions, of rising cost. Does a sensor read in another unit, or along other axes, than the
body moves (`readings`)? Does the window fit at all? Where it does not, what would explain it
(`explain`)? An answer names sensors, which then count little; until there is one, and where there
is none, the status is `doubtful` and says why.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from continuum_loc.estimator.base_watch import BaseWatch
from continuum_loc.estimator.bending import BendWatch
from continuum_loc.estimator.explain import explanations, Round, Stretch
from continuum_loc.estimator.factors import Factor, Setup
from continuum_loc.estimator.fit import consistency, fit_of, misfit_by_factor, share_by_factor
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.readings import curvature_cause, range_cause, travel_cause
from continuum_loc.estimator.settings import DoubtSettings
from continuum_loc.estimator.turning import TurnWatch
from continuum_loc.estimator.window import Window
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    ImuSample,
    Measurement,
    seconds,
    StrainSample,
    TofFrame,
)
from continuum_loc.plausible import gyro_noise
import numpy as np

NEWEST = 5  # intervals that are solved again, and that say whether the window fits now
LASTING = 5.0  # [s] that a cause is told without being found again
BACKOFF_LIMIT = 16.0  # [s] longest time between two rounds without a finding
ENOUGH = 0.4  # [s] of data before anything is said
NOISE_SAMPLES = 40  # of a gyro, whose noise tells its unit
BADLY = 1.5  # times what makes all doubtful: one factor alone may be off by more
CURVATURES = 8  # newest samples of the strain, whose noise tells its unit
MOST = 0.7  # of a kind's samples have to fit, whatever else does
LOW_SHARE = 0.6  # of a sensor's fitting samples: somebody is wrong
BASES = ('base', 'insertion')  # which let go where all else has the base elsewhere
BLIND = 'no usable zone'


class Doubts:
    """
    Whatever makes the filter doubt, by step.

    causes: why a sensor (or `base`, `insertion`, `strain`) is not to be believed, by name.
    reasons: why the estimate is doubtful, in words; none where it is not.
    """

    def __init__(
        self, setup: Setup, window: Window, factors: Sequence[Factor], settings: DoubtSettings
    ):
        self.causes: dict[str, str] = {}
        self.reasons: tuple[str, ...] = ()
        self._setup, self._window, self._factors, self._settings = setup, window, factors, settings
        self._recent: deque[Measurement] = deque()
        self._told_at: dict[str, float] = {}
        self._since: dict[str, float] = {}
        self._round: Round | None = None
        named = {factor.name for factor in factors}
        self._turns, self._bends = watches(setup, factors)
        self._comparisons = deque(one for one in (self._turns, self._bends) if one)
        self._curvature: deque[np.ndarray] = deque(maxlen=CURVATURES)
        self._noise: dict[str, deque[np.ndarray]] = {}
        self.base = BaseWatch(setup, window)
        self._off = False  # the window does not fit, and no round of explanations has been yet
        self._next_round, self._backoff, self._next_reading = 0.0, 1.0, 0.0
        self._unused = self._is_unused(setup)
        self._consumed = tuple(factor.consumes for factor in factors)
        self._candidates = explanations(setup.robot, named)

    def note(self, measurement: Measurement, time: float, used: bool) -> None:
        """Keep a measurement that was used for as long as it may be solved again."""
        if not self._settings.enabled:
            return
        if used and isinstance(measurement, self._consumed):
            self._recent.append(measurement)
            if isinstance(measurement, StrainSample):
                self._hear_strain(measurement, time)
            self.base.note(measurement, time)
        self._read_at_once(measurement, time)

    def _read_at_once(self, measurement: Measurement, time: float) -> None:
        """Judge what one measurement alone shows to be in another unit."""
        robot = self._setup.robot
        if isinstance(measurement, ImuSample) and self._turns:
            kept = self._noise.setdefault(measurement.sensor, deque(maxlen=NOISE_SAMPLES))
            kept.append(measurement.angular_velocity)
        if isinstance(measurement, TofFrame):
            cause = range_cause(measurement.ranges, robot.tof_model.max_range)
            if cause:
                self._tell((measurement.sensor,), cause, time)
        if isinstance(measurement, EncoderSample) and 'insertion' in measurement.names:
            insertion = robot.base.insertion
            travel = float(measurement.position[measurement.names.index('insertion')])
            cause = travel_cause(travel, insertion.range)
            if cause and insertion.mode == 'measured' and np.isfinite(travel):
                self._tell(('insertion',), cause, time)

    def _hear_strain(self, measurement: StrainSample, time: float) -> None:
        """Keep a sample for its comparison, and judge whether any body bends so."""
        if self._bends:
            self._bends.note(time, measurement)
        self._curvature.append(measurement.kappa)
        alike = [one for one in self._curvature if one.shape == measurement.kappa.shape]
        robot = self._setup.robot
        cause = curvature_cause(np.array(alike), robot.strain.kappa_sigma, robot.radius)
        if cause:
            self._tell(('strain',), cause, time)

    @property
    def pending(self) -> bool:
        """Whether an explanation is looked for, before which nobody else is accused."""
        return self._round is not None or self._off

    def look(self, time: float, epoch: int) -> None:
        """Ask the questions at the end of a step at `time` [s]."""
        if not self._settings.enabled or time < ENOUGH:
            return
        self._forget(time, epoch)
        # Where the rest does not fit either, base and encoder are no better witnesses.
        off = self._does_not_fit()
        for name, cause in self.base.causes(time).items():
            self._tell((name,), '' if off else cause, time)
        if time >= self._next_reading:
            self._next_reading = time + self._settings.period
            self._read(time)
        self._compare(time)
        self._explain(time, epoch)
        self._judge(time)

    # -------------------------------------------------------------------- units, axes and signs

    def _read(self, time: float) -> None:
        """Judge gyros by their noise."""
        for name, read in self._noise.items():
            cause = gyro_noise(np.array(read), self._setup.robot.imu_model.gyro_sigma)
            if cause:
                self._tell((name,), cause, time)

    def _compare(self, time: float) -> None:
        """Compare one kind of sensor with a body that knows nothing of it, by turns."""
        for one in self._comparisons:
            causes = one.look(self._window)
            if causes is not None:
                for name, cause in causes.items():
                    self._tell((name,), cause, time)
                self._comparisons.rotate(-1 - self._comparisons.index(one))
                return

    # ------------------------------------------------------------------------ what would explain

    def _explain(self, time: float, epoch: int) -> None:
        """Go on with a round of explanations, or begin one where the window does not fit."""
        if self._round is None:
            if time < self._next_round or not self._uneasy(time):
                return
            self._round = Round.of(self._stretch(epoch), self._candidates)
            return
        if not self._round.step():
            return
        found, self._round, self._off = self._round.verdict(), None, False
        self._backoff = 1.0 if found else min(2.0 * self._backoff, BACKOFF_LIMIT)
        self._next_round = time + self._backoff
        if found is not None:
            self._tell(found.sensors, found.cause, time)

    def _stretch(self, epoch: int) -> Stretch:
        believed = [one for one in self._recent if _source(one) not in self.causes]
        return Stretch(self._setup, self._window, epoch, believed, NEWEST)

    def _uneasy(self, time: float) -> bool:
        """Whether the window has not fitted for some time, whoever is to blame."""
        self._off = self._does_not_fit()
        return self._lasts('uneasy', self._off, time, self._settings.patience)

    def _does_not_fit(self) -> bool:
        newest = self._window.intervals[-NEWEST:]
        shares = fit_of(newest).shares
        known = [share for name, share in shares.items() if name not in (*self.causes, *BASES)]
        misfits = [
            misfit
            for name, misfit in misfit_by_factor(newest).items()
            if name != 'gyro' and name not in (*self.causes, *BASES)
        ]
        return (
            self._misfit(newest) > self._settings.uneasy
            or max(misfits, default=0.0) > BADLY * self._settings.consistency
            or min(known, default=1.0) < LOW_SHARE
        )

    @staticmethod
    def _misfit(intervals: Sequence[Interval]) -> float:
        """Mean squared residual; of gyros only the knots know how much is rattle."""
        return consistency(intervals, without=('gyro',))

    # ---------------------------------------------------------------------- whether to believe it

    def _judge(self, time: float) -> None:
        """Collect why the estimate is doubtful."""
        reasons = [self._unused] if self._unused else []
        misfit = self._misfit(self._window.intervals)
        if self._lasts('off', misfit > self._settings.consistency, time, 0.5):
            reasons.append(
                f'measurements are {np.sqrt(misfit):.1f} standard deviations off on average'
            )
        for name, share in share_by_factor(self._window.intervals).items():
            if self._lasts(f'{name} misfit', name != 'gyro' and share < MOST, time, 0.5):
                reasons.append(f'only {100 * share:.0f} % of the {name} samples fit')
        if self._lasts('blind', self._blind(), time, 0.5):
            reasons.append(f'{BLIND} in any ToF frame')
        reasons += [
            f'{name} {self.causes[name]}'
            for name in ('base', 'insertion', *(one.name for one in self._setup.robot.trackers))
            if name in self.causes
        ]
        self.reasons = tuple(reasons)

    def _blind(self) -> bool:
        """Whether there are ToF frames in the window, and no usable zone in them."""
        tof = next((one for one in self._factors if one.name == 'tof'), None)
        if tof is None:
            return False
        usable = [
            interval.reports[tof].fits[:, 0].sum()
            for interval in self._window.intervals
            if tof in interval.reports
        ]
        return bool(usable) and sum(usable) == 0.0

    @staticmethod
    def _is_unused(setup: Setup) -> str:
        robot = setup.robot
        if robot.tof and setup.settings.tof.enabled and setup.prior_map is None:
            return f'no prior map: {len(robot.tof)} ToF sensors are not used'
        return ''

    # ------------------------------------------------------------------------------------- memory

    def _tell(self, sensors: tuple[str, ...], cause: str, time: float) -> None:
        for name in sensors:
            if cause:
                self.causes[name], self._told_at[name] = cause, time
            elif time - self._told_at.get(name, -np.inf) > LASTING:
                self.causes.pop(name, None)

    def _lasts(self, what: str, true: bool, time: float, patience: float) -> bool:
        """Whether something has been true for `patience` seconds."""
        if not true:
            self._since.pop(what, None)
            return False
        return time - self._since.setdefault(what, time) >= patience

    def _forget(self, time: float, epoch: int) -> None:
        first = self._window.columns[0].time
        while self._recent and seconds(self._recent[0].stamp, epoch) < first:
            self._recent.popleft()
        for name, told in list(self._told_at.items()):
            if time - told > BACKOFF_LIMIT:  # what is still so will be found again
                self.causes.pop(name, None)


def watches(setup: Setup, factors: Sequence[Factor]) -> tuple[TurnWatch | None, BendWatch | None]:
    """Make what compares gyros and strain, where enough else tells of the body."""
    robot, by_name = setup.robot, {factor.name: factor for factor in factors}
    told_by = {'tof': robot.tof, 'tracker': robot.trackers, 'field': robot.hall}
    absolute = any(name in by_name and sensors for name, sensors in told_by.items())
    strain = 'strain' in by_name and robot.strain is not None
    gyros = 'gyro' in by_name and bool(robot.imu) and (absolute or strain)
    return (
        TurnWatch(setup, by_name['gyro']) if gyros else None,
        BendWatch(setup, by_name['strain']) if strain and absolute else None,
    )


def _source(measurement: Measurement) -> str:
    """Name under which a measurement's sensor is accused."""
    kinds = {StrainSample: 'strain', EncoderSample: 'insertion', BaseSample: 'base'}
    return kinds.get(type(measurement)) or getattr(measurement, 'sensor', '')
