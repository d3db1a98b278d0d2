"""
The sliding-window filter: start reading here.

A measurement enters by `process`. Its stamp puts it into the interval between two knots of the
`Window`; when a `Cycle` of ToF frames is complete (or `output_rate` says so) the window is solved
and an `Estimate` comes out. `Recovery` notices a body in a wrong minimum and finds it again.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter
import time as clock

from continuum_loc.corrections import Corrections
from continuum_loc.errors import MeasurementError, QueryError, SingularError
from continuum_loc.estimate import Estimate, Status
from continuum_loc.estimator.calibrator import Calibrator
from continuum_loc.estimator.cycle import Cycle
from continuum_loc.estimator.doubts import Doubts
from continuum_loc.estimator.factors import Factor, FACTORS, Guess, Setup
from continuum_loc.estimator.factors.mechanics import MechanicsFactor
from continuum_loc.estimator.fit import Fit, fit_of, rattle
from continuum_loc.estimator.health import Health
from continuum_loc.estimator.interpolation import backbone, BodyState, rattle_covariance
from continuum_loc.estimator.loads import Loads
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.query import History, state_at
from continuum_loc.estimator.recovery import Recovery
from continuum_loc.estimator.rest import InitialRest
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.solver import track
from continuum_loc.estimator.start import Start
from continuum_loc.estimator.state import column_at_rest, Grid, TIME_EPSILON
from continuum_loc.estimator.window import Window
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import Measurement, nanoseconds, seconds
from continuum_loc.robot import RobotDescription
import numpy as np
from threadpoolctl import ThreadpoolController

MOST_CLOCK = 0.3  # [s] by which a clock may be off
FIRST_PATIENCE = 0.5  # [s] that the first step waits for what tells base and shape


class SlidingWindowFilter:
    """
    Pose, strain and velocity of the whole body, online.

    robot: the description; prior_map: a `PriorMap`, or None for a robot without ToF sensors.
    counts: {"received" | "used" | "dropped" | "restarts": Counter}, the latter two by reason.
    """

    def __init__(
        self, robot: RobotDescription, prior_map=None, settings: EstimatorSettings | None = None
    ):
        self.robot = robot
        self.settings = settings or EstimatorSettings()
        self.grid = Grid(robot, self.settings.node_spacing)
        self.priors = Priors(robot, self.grid, self.settings)
        self.setup = Setup(robot, self.grid, self.settings, prior_map)
        self.counts = {kind: Counter() for kind in ('received', 'used', 'dropped', 'restarts')}
        s_imu = {imu.name: robot.sensor_arclength(imu.name) for imu in robot.imu}
        self._s_imu = dict(sorted(s_imu.items(), key=itemgetter(1)))
        self._backbone_s = np.linspace(0.0, robot.length, self.settings.backbone_points)
        self._threads = ThreadpoolController()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counts; the next measurement starts anew."""
        self.epoch: int | None = None
        self._describe(self.robot)
        self.newest: int = 0
        self.priors.let_go(False)
        self.factors = [kind(self.setup) for kind in FACTORS if kind.wanted(self.setup)]
        self._factors_of: dict[type, list[Factor]] = {}
        awaited = [one.consumes for one in self.factors if one.awaited()]
        self._awaited = {
            kind for one in awaited for kind in (one if type(one) is tuple else (one,))
        }
        self._needed = {one.needed() for one in self.factors if one.needed()}
        self.window = Window(self.grid, self.priors, self.settings)
        self.history = History(self.settings.history)
        self._calibrator = self._new_calibrator()
        self._watch()
        tendons = next((one for one in self.factors if isinstance(one, MechanicsFactor)), None)
        self._loads = Loads(self.setup, self.window, tendons) if tendons else None
        self.start = Start(self.setup, self.window, self.factors)
        self._rest = InitialRest(self.robot, self.grid, self.settings.gyro)
        self._cycle = Cycle(self.factors, self.settings.output_rate)

    def forget_faults(self) -> None:
        """Believe every sensor again, until it is found out anew; the body stays."""
        acquired = self.recovery.acquired
        for factor in self.factors:
            factor.weigh((), 1.0)
        self._watch()
        self.recovery.acquired = acquired
        for interval in self.window.intervals:
            interval.changed = True

    def use_map(self, prior_map: PriorMap) -> None:
        """
        Match to another map from now on; the body and its biases stay, faults are forgotten.

        What was measured in the window is matched anew. A filter that had no map starts anew, and
        so does one whose base is searched for, since it is in the map that it is.
        """
        anew = self.setup.prior_map is None or self.start.wanted
        self.setup = replace(self.setup, prior_map=prior_map)
        if anew:
            self.reset()
            return
        for factor in self.factors:
            rows = [row for interval in self.window.intervals for row in interval.rows(factor)]
            factor.use_map(self.setup, rows)
        self.forget_faults()

    def _watch(self) -> None:
        """Make those who watch how well it fits, without a past."""
        self.health = Health(self.robot, self.window, self.factors, self.settings.health)
        self.recovery = Recovery(
            self.robot, self.window, self.factors, self.health, self.settings.recovery
        )
        self.doubts = Doubts(self.setup, self.window, self.factors, self.settings.doubts)
        if self._calibrator is not None:
            self.health.corrected = {}
            self.doubts.base.spread = self._calibrator.spread

    # -------------------------------------------------------------- measurements in, estimates out

    def process(self, measurement: Measurement) -> Estimate | None:
        """
        Take one measurement; an Estimate when a step fell due.

        Measurements that cannot be used are counted.
        """
        self.counts['received'][type(measurement).__name__] += 1
        if self._calibrator is not None:
            self._calibrate(measurement)
        measurement = self._corrections.applied(measurement)
        estimate = self._step() if self._cycle.over(measurement) else None
        if self._admit(measurement) and self._cycle.complete(measurement):
            estimate = self._step()
        return estimate

    def flush(self) -> Estimate | None:
        """Solve what is pending at the end of the data."""
        return self._step() if self._cycle.running else None

    def query(self, stamp: int, s: float) -> BodyState:
        """
        Mean and covariance of pose, strain and velocity at a stamp [ns] and arclength s [m].

        Inside the window, behind it as far as `history` reaches (smoothed by the knots that
        followed), and ahead of it at constant body-frame velocity, with a covariance that grows.
        Raises QueryError beyond these.
        """
        if self.epoch is None or not self.window.intervals:
            raise QueryError('nothing was estimated yet: process measurements first')
        if not 0.0 <= s <= self.robot.length:
            raise QueryError(f'arclength {s} m is off the body; valid: 0 to {self.robot.length} m')
        time = seconds(stamp, self.epoch)
        state = state_at(self.window, self.history, time, s)
        if time >= self.window.columns[0].time:
            state.covariance[:6, :6] += self._rattle_covariance(time, np.array([s]))[0]
        return state

    def resolve(self, stamps: Sequence[int]) -> list[Estimate]:
        """
        Linearise the whole window anew until it converges; its estimates at `stamps` [ns].

        Raises QueryError for a stamp outside the window.
        """
        started = clock.perf_counter()
        first, last = self.window.columns[0].time, seconds(self.newest, self.epoch)
        with self._threads.limit(limits=1, user_api='blas'):
            self.window.mark_changed()
            outcome = self.recovery.acquire()
            fit, out = fit_of(self.window.intervals), []
            for stamp in stamps:
                time = seconds(stamp, self.epoch)
                if not first - TIME_EPSILON <= time <= last + TIME_EPSILON:
                    raise QueryError(
                        f'stamp {stamp} is outside the window, '
                        f'{self.epoch + nanoseconds(first)} to {self.newest} ns'
                    )
                out.append(self._compose(time, fit, outcome, started))
        return out

    def _admit(self, measurement: Measurement) -> bool:
        """Put the measurement into its interval; False where it was dropped and counted."""
        if self._needed:
            self._needed.discard(type(measurement))
        if self._needed:
            self.counts['dropped']['before the base was told'] += 1
            return False
        if self.epoch is None:
            self._start(measurement.stamp)
        time = seconds(measurement.stamp, self.epoch)
        if time < self.window.columns[0].time - TIME_EPSILON:
            self.counts['dropped']['older than the window'] += 1
            return False
        used = [self._add(one, time, measurement) for one in self._consumers(type(measurement))]
        if any(used):
            self.counts['used'][type(measurement).__name__] += 1
            self.newest = max(self.newest, measurement.stamp)
            self._awaited.discard(type(measurement))
            self._rest.note(measurement)
            self.health.hear(getattr(measurement, 'sensor', ''), time)
        self.doubts.note(measurement, time, any(used))
        self.start.note(measurement)
        return any(used)

    def _consumers(self, kind: type) -> list[Factor]:
        """Return the factors that a kind of measurement is for."""
        if kind not in self._factors_of:
            self._factors_of[kind] = [
                factor for factor in self.factors if issubclass(kind, factor.consumes)
            ]
        return self._factors_of[kind]

    def _add(self, factor: Factor, time: float, measurement: Measurement) -> bool:
        try:
            row = factor.row(measurement)
        except MeasurementError as error:
            self.counts['dropped'][f'{factor.name}: {error.reason}'] += 1
            return False
        time -= factor.lateness(measurement)
        if time < self.window.columns[0].time - TIME_EPSILON:
            self.counts['dropped']['older than the window'] += 1
            return False
        self.window.interval_at(time).add(factor, time, row)
        return True

    def _start(self, stamp: int) -> None:
        self.epoch = self.newest = stamp
        strain = np.tile(self.priors.rest, (self.grid.nodes, 1))
        self.window.start(column_at_rest(self.grid, self.priors.T_map_base, strain, 0.0))

    # ------------------------------------------------------------------ one step

    def _step(self) -> Estimate | None:
        output = self._cycle.finish(self.newest)
        early = seconds(self.newest, self.epoch) < FIRST_PATIENCE
        if not self.window.intervals or (self._awaited and early):
            return None
        started = clock.perf_counter()
        with self._threads.limit(limits=1, user_api='blas'):
            # Small matrices: more threads only wait for one another.
            time = seconds(output, self.epoch)
            if self.start.pending and not self.recovery.acquired:
                return self._locate(time)
            outcome = self._solve(time)
            told = not self.start.pending
            self.start.watch(time, self.recovery.worst_share())
            if told and self.start.pending:
                self.recovery.lose()  # this last estimate says so
            return self._estimate(time, outcome, started) if told else None

    def _locate(self, time: float) -> None:
        """Look for the base, and tell nothing."""
        if self.start.due(time):
            self.start.tried(time, *self.recovery.locate(self.start.bodies()))

    def _solve(self, time: float) -> tuple[int, bool]:
        if not self.recovery.acquired and len(self.window.columns) == 2 and not self.window.pinned:
            self._guess()
        try:
            outcome = (
                track(self.window, time) if self.recovery.acquired else self.recovery.acquire()
            )
        except SingularError:
            self.counts['restarts']['singular'] += 1
            self.window.keep_newest(1)
            outcome = self.recovery.acquire()
        self._rest.finish(self.window, time)
        self.doubts.look(time, self.epoch)
        self.health.hear_of(self.doubts)
        if self.priors.let_go('base' in self.doubts.causes):
            self.window.mark_changed()
        self.recovery.look_after(time, outcome[1])
        self.history.note(self.window)
        return outcome

    # ------------------------------------------------------- the robot itself, as it turns out

    def _describe(self, robot: RobotDescription) -> None:
        """Take what is measured from now on for that of a robot with other constants."""
        self.setup.robot, self._corrections = robot, Corrections(robot)
        self.priors.describe(robot)

    def _new_calibrator(self) -> Calibrator | None:
        self._raw: deque[Measurement] = deque()
        if not self.settings.calibration.enabled:
            return None
        prior_map = self.setup.prior_map
        middle = None if prior_map is None else prior_map.points.mean(axis=0)
        parameters = Parameters(self.robot, middle=middle)
        if parameters.size == 0:
            return None
        return Calibrator(parameters, self.window, self.settings.calibration)

    def _calibrate(self, measurement: Measurement) -> None:
        """
        Keep a measurement as it came, and find out whether the robot is what it is taken for.

        It is done between a step and the next measurement, so that no estimate waits for it.
        """
        self._raw.append(measurement)
        if self.epoch is None or not self.window.intervals:
            return
        oldest = self.window.columns[0].time - TIME_EPSILON
        while seconds(self._raw[0].stamp, self.epoch) < oldest - MOST_CLOCK and len(self._raw) > 1:
            self._raw.popleft()
        step = self._calibrator.due(seconds(self.newest, self.epoch))
        if step is None:
            return
        self._raw.pop()  # it is about to enter
        watch = self.settings.health
        self._describe(self._calibrator.take(step).robot)
        self.health.corrected = self._calibrator.late(watch.clock_offset, watch.clock_sigmas)
        for factor in self.factors:
            factor.describe(self.setup.robot)
        for interval in self.window.intervals:
            interval.clear()
        for one in self._raw:
            one = self._corrections.applied(one)
            at = seconds(one.stamp, self.epoch)
            if at <= self.window.columns[-1].time + TIME_EPSILON:
                self.window.enter(self.factors, at, one)
        self._raw.append(measurement)

    def _guess(self) -> None:
        """Start from what the first samples tell of base and shape; straight without them."""
        column = self.window.columns[0]
        guess = Guess(column.T[0], column.strain.copy(), column.T_map_frame)
        for factor in self.factors:
            for row in self.window.intervals[-1].rows(factor)[:1]:
                factor.guess(row, guess)
        self.window.place(
            column_at_rest(
                self.grid,
                guess.T_map_base,
                guess.strain,
                column.time,
                column.bias,
                guess.T_map_frame,
            )
        )

    # ------------------------------------------------------------------ the output

    def _estimate(self, now: float, outcome: tuple[int, bool], started: float) -> Estimate:
        before, lagged, fit = now - self.settings.lag, None, fit_of(self.window.intervals)
        if self.settings.lag > 0.0 and before >= self.window.columns[0].time:
            lagged = self._compose(before, fit, outcome, started)
        if self._loads is not None:
            self._loads.look(now)
        return self._compose(now, fit, outcome, started, lagged)

    def _status(self) -> Status:
        """Say what to tell of the body; nothing but an undisputed fit is tracking."""
        status = 'lost' if self.start.astray else self.recovery.status
        return 'doubtful' if status == 'tracking' and self.doubts.reasons else status

    def _rattle_covariance(self, time: float, s: np.ndarray) -> np.ndarray:
        """
        Covariance (m, 6, 6) at s (m,) of what gyros feel and the motion of the knots misses.

        The larger of the interval's that holds `time` and the one before: the newest may have
        just begun.
        """
        k = self.window.knot_before(time)
        recent = slice(max(k - 1, 0), k + 1)
        variances = rattle(self.window.intervals[recent])
        s_imu = {name: self._s_imu[name] for name in self._s_imu if name in variances}
        turns = np.sqrt([variances[name] for name in s_imu]).reshape(-1, 3)
        return rattle_covariance(np.array(list(s_imu.values())), turns, s)

    def _compose(
        self,
        time: float,
        fit: Fit,
        outcome: tuple[int, bool],
        started: float,
        lagged: Estimate | None = None,
    ) -> Estimate:
        rings, body = self.grid.ring_nodes, self.window.body(time)
        covariance = self.window.motion_covariance(time, rings)
        covariance[:, :6, :6] += self.recovery.doubt(self.grid.s[rings])
        covariance[:, :6, :6] += self._rattle_covariance(time, self.grid.s[rings])
        if self._calibrator is not None:
            covariance[:, :6, :6] += self._calibrator.spread(rings)
        covariance[1:, :6, :6] += np.diag(np.square(np.repeat(self.settings.calibration_sigma, 3)))
        T_map_frame, frame_covariance = self.window.frame(time)
        return Estimate(
            stamp=self.epoch + nanoseconds(time),
            T_map_ring=body.T[rings],
            covariance=covariance[:, :6, :6],
            strain=body.strain[rings],
            velocity=body.velocity[rings],
            velocity_covariance=covariance[:, 6:, 6:],
            backbone_s=self._backbone_s,
            T_map_backbone=backbone(self.grid, body.T, body.strain, self._backbone_s),
            status=self._status(),
            doubts=self.doubts.reasons,
            consistency=fit.squared / max(fit.count, 1),
            inliers=fit.shares,
            suspects=dict(self.health.reasons),
            iterations=outcome[0],
            converged=outcome[1],
            step_seconds=clock.perf_counter() - started,
            lagged=lagged,
            T_map_frame=T_map_frame,
            frame_covariance=frame_covariance,
            loads=self._loads.found if self._loads is not None else (),
        )
