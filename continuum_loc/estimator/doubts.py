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
from continuum_loc.estimator.explain import Explanation, explanations, Round, Stretch
from continuum_loc.estimator.factors import Factor, Setup
from continuum_loc.estimator.fit import consistency, fit_of, misfit_by_factor, share_by_factor
from continuum_loc.estimator.interpolation import interpolated
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.readings import gyro_cause, range_cause, strain_cause, travel_cause
from continuum_loc.estimator.settings import DoubtSettings
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
# [s] between two gyros that are judged apart, at first and later, and how often at first
PATROL, SELDOM, FIRST_PATROLS = 1.0, 20.0, 1
PATROLLED = 3  # intervals that are solved again for it
BADLY = 1.5  # times what makes all doubtful: one factor alone may be off by more
MOST = 0.7  # of a kind's samples have to fit, whatever else does
LOW_SHARE = 0.6  # of a sensor's fitting samples: somebody is wrong
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
        self._gyro_names = [imu.name for imu in setup.robot.imu if 'gyro' in named]
        self._patrolled, self._next_patrol = 0, PATROL
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
            self.base.note(measurement, time)
        self._read_at_once(measurement, time)

    def _read_at_once(self, measurement: Measurement, time: float) -> None:
        """Judge what one measurement alone shows to be in another unit."""
        robot = self._setup.robot
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

    @property
    def pending(self) -> bool:
        """Whether an explanation is looked for, before which nobody else is accused."""
        return self._round is not None or self._off

    def look(self, time: float, epoch: int) -> None:
        """Ask the questions at the end of a step at `time` [s]."""
        if not self._settings.enabled or time < ENOUGH:
            return
        self._forget(time, epoch)
        for name, cause in self.base.causes(time).items():
            self._tell((name,), cause, time)
        if time >= self._next_reading:
            self._next_reading = time + self._settings.period
            self._read(time, epoch)
        self._explain(time, epoch)
        self._judge(time)

    # -------------------------------------------------------------------- units, axes and signs

    def _read(self, time: float, epoch: int) -> None:
        """Compare gyros and strain with the body."""
        robot, settings = self._setup.robot, self._setup.settings
        for name, (body, read) in self._gyros(epoch, self._window).items():
            self._tell((name,), self._gyro_cause(body, read), time)
        if robot.strain is not None and settings.strain.enabled:
            body, theta, kappa = self._bending(epoch)
            cause = strain_cause(body, theta, kappa, robot.strain.kappa_sigma)
            self._tell(('strain',), cause, time)

    def _gyros(self, epoch: int, window: Window) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Angular velocities (K, 3) of the body and as read, in each IMU's frame [rad/s]."""
        robot, grid = self._setup.robot, self._setup.grid
        samples = [one for one in self._recent if isinstance(one, ImuSample)]
        found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for imu in robot.imu:
            mine = [one for one in samples if one.sensor == imu.name]
            if not mine:
                continue
            times = np.array([seconds(one.stamp, epoch) for one in mine])
            node = grid.node_at(robot.sensor_arclength(imu.name))
            omega = _rates(window, times, node)
            inside = np.isfinite(omega[:, 0])
            read = np.array([one.angular_velocity for one in mine])
            body = omega @ imu.mount.T_ring_sensor[:3, :3]
            found[imu.name] = body[inside], read[inside]
        return found

    def _bending(self, epoch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bending (K, 2) of the body [1/m], and theta and kappa (K,) as read, where they were."""
        s_nodes, window = self._setup.grid.s, self._window
        body, theta, kappa = [np.empty((0, 2))], [np.empty(0)], [np.empty(0)]
        for one in self._recent:
            if not isinstance(one, StrainSample):
                continue
            time = seconds(one.stamp, epoch)
            if not window.columns[0].time <= time <= window.columns[-1].time:
                continue
            strain = window.body(time).strain
            bending = [np.interp(one.s, s_nodes, strain[:, axis]) for axis in (4, 5)]
            body.append(np.column_stack(bending))
            theta.append(one.theta)
            kappa.append(one.kappa)
        return np.concatenate(body), np.concatenate(theta), np.concatenate(kappa)

    # ------------------------------------------------------------------------ what would explain

    def _explain(self, time: float, epoch: int) -> None:
        """Go on with a round of explanations, or begin one where the window does not fit."""
        if self._round is None:
            if time < self._next_round or not self._uneasy(time):
                self._patrol(time, epoch)
                return
            self._round = Round.of(self._stretch(epoch), self._ordered())
            return
        done = self._round.step()
        named = self._unmasked(self._round, time, epoch)
        if not (done or named):
            return
        found, self._round, self._off = self._round.verdict(), None, False
        self._backoff = 1.0 if found or named else min(2.0 * self._backoff, BACKOFF_LIMIT)
        self._next_round = time + self._backoff
        if found is not None and not named:
            self._tell(found.sensors, found.cause, time)

    def _patrol(self, time: float, epoch: int) -> None:
        """
        Judge a gyro by a body that knows nothing of it, now and then.

        One with a wrong axis may fit well enough, as its own weight draws the body along.
        """
        if time < self._next_patrol or not self._gyro_names:
            return
        name = self._gyro_names[self._patrolled % len(self._gyro_names)]
        self._patrolled += 1
        rounds = self._patrolled // len(self._gyro_names)
        self._next_patrol = time + (PATROL if rounds < FIRST_PATROLS else SELDOM)
        explanation = next(one for one in self._candidates if one.sensors == (name,))
        outcome = self._stretch(epoch, PATROLLED).solve(explanation, near=True)
        if outcome is not None:
            self._judge_gyro(name, outcome.window, time, epoch)

    def _unmasked(self, round_: Round, time: float, epoch: int) -> bool:
        """Whether the gyro that was just left out turns out to read otherwise than the rest."""
        if not round_.gains:
            return False
        _, explanation, outcome = round_.gains[-1]
        if explanation.kind != 'gyro' or len(explanation.sensors) > 1:
            return False
        return self._judge_gyro(explanation.sensors[0], outcome.window, time, epoch)

    def _judge_gyro(self, name: str, window: Window, time: float, epoch: int) -> bool:
        found = self._gyros(epoch, window).get(name)
        cause = self._gyro_cause(*found) if found else ''
        if cause:
            self._tell((name,), cause, time)
        return bool(cause)

    def _gyro_cause(self, body: np.ndarray, read: np.ndarray) -> str:
        sigma = self._setup.robot.imu_model.gyro_sigma
        bias = self._setup.settings.gyro.bias_sigma
        return gyro_cause(body, read, sigma, bias) or gyro_noise(read, sigma)

    def _ordered(self) -> list[Explanation]:
        """Explanations, first those by a gyro that shares its ring with what does not fit."""
        robot = self._setup.robot
        shares = fit_of(self._window.intervals[-NEWEST:]).shares
        low = {name for name, share in shares.items() if share < LOW_SHARE}
        rings = {sensor.ring for sensor in robot.sensors if sensor.name in low}
        if len(rings) > len(robot.rings) / 2:
            return self._candidates
        gyros = {imu.name for imu in robot.imu if imu.ring in rings}
        return sorted(self._candidates, key=lambda one: not set(one.sensors) <= gyros)

    def _stretch(self, epoch: int, newest: int = NEWEST) -> Stretch:
        believed = [one for one in self._recent if _source(one) not in self.causes]
        return Stretch(self._setup, self._window, epoch, believed, newest)

    def _uneasy(self, time: float) -> bool:
        """Whether the window has not fitted for some time, whoever is to blame."""
        newest = self._window.intervals[-NEWEST:]
        shares = fit_of(newest).shares
        known = [shares[name] for name in shares if name not in self.causes]
        misfits = [
            misfit
            for name, misfit in misfit_by_factor(newest).items()
            if name != 'gyro' and name not in self.causes
        ]
        off = (
            self._misfit(newest) > self._settings.uneasy
            or max(misfits, default=0.0) > BADLY * self._settings.consistency
            or min(known, default=1.0) < LOW_SHARE
        )
        self._off = off
        return self._lasts('uneasy', off, time, self._settings.patience)

    @staticmethod
    def _misfit(intervals: Sequence[Interval]) -> float:
        """Mean squared residual; of gyros only the knots know how much is rattle."""
        return consistency(intervals, without='gyro')

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


def _source(measurement: Measurement) -> str:
    """Name under which a measurement's sensor is accused."""
    kinds = {StrainSample: 'strain', EncoderSample: 'insertion', BaseSample: 'base'}
    return kinds.get(type(measurement)) or getattr(measurement, 'sensor', '')


def _rates(window: Window, times: np.ndarray, node: int) -> np.ndarray:
    """Angular velocity (K, 3) of a node at increasing times (K,), nan outside the window."""
    found = np.full((len(times), 3), np.nan)
    knots = np.array([column.time for column in window.columns])
    which = np.searchsorted(knots, times) - 1
    for k in np.unique(which[(which >= 0) & (which < len(window.intervals))]):
        at = np.flatnonzero(which == k)
        a, b = window.column(k), window.column(k + 1)
        nodes = np.full(len(at), node)
        found[at] = interpolated(a, b, times[at] - a.time, nodes).v[:, 3:]
    return found
