"""The sliding-window filter: start reading here.

A measurement enters by `process`. Its stamp puts it into the interval between two knots; when a cycle of ToF frames
is complete (or `output_rate` says so) the window is solved and an `Estimate` comes out. The window is a chain of
columns (the body at knot times) coupled by intervals (priors and measurements between two knots); the oldest column
is marginalised as the window moves on.
"""

from __future__ import annotations

import time as clock
from collections import Counter, deque

import numpy as np

from continuum_loc import lie
from continuum_loc.estimator.chain import Chain, SingularError
from continuum_loc.estimator.estimate import Estimate
from continuum_loc.estimator.factors import FACTORS, Factor, MeasurementError, TofFactor
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.output import MOTION, Body, backbone, body_between, motion_covariance
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import NODE_DIM, Column, Grid, column_at_rest
from continuum_loc.measurements import ImuSample, Measurement, TofFrame, seconds
from continuum_loc.robot import RobotDescription

TIME_EPSILON = 1e-9  # stamps are integer nanoseconds
COST_SLACK = 1e-3  # relative: associations change between iterations, so costs compare only so well


class SlidingWindowFilter:
    """Pose, strain and velocity of the whole body, online.

    robot: the description; prior_map: a `PriorMap`, or None for a robot without ToF sensors.
    counts: {"received" | "used" | "dropped": Counter}, dropped by reason.
    """

    def __init__(self, robot: RobotDescription, prior_map=None, settings: EstimatorSettings | None = None):
        self.robot = robot
        self.settings = settings or EstimatorSettings()
        self.grid = Grid(robot, self.settings.node_spacing)
        self.priors = Priors(robot, self.grid, self.settings)
        self.tof = self._make_tof(prior_map)
        self.factors: list[Factor] = [kind(robot, self.grid, self.settings) for kind in FACTORS
                                      if self._wanted(kind.name)]
        if self.tof is not None:
            self.factors.append(self.tof)
        self._backbone_s = np.linspace(0.0, robot.length, self.settings.backbone_points)
        self.counts = {"received": Counter(), "used": Counter(), "dropped": Counter()}
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counts; the next measurement starts anew."""
        self.epoch: int | None = None
        self.newest: int = 0
        self.columns: list[Column] = []
        self.offsets: list[np.ndarray] = []
        self.intervals: list[Interval] = []
        self.chain: Chain | None = None
        self.acquired = False
        self._marginalised = False
        self._cycle: set[str] = set()
        self._last_cycle: set[str] = set()
        self._cycle_start: int | None = None
        self._rest: dict[str, list[np.ndarray]] | None = {}

    # ------------------------------------------------------------------ measurements in, estimates out

    def process(self, measurement: Measurement) -> Estimate | None:
        """Take one measurement; an Estimate when a step fell due. Measurements that cannot be used are counted."""
        self.counts["received"][type(measurement).__name__] += 1
        estimate = self._step() if self._cycle_over(measurement) else None
        if self._admit(measurement) and self._cycle_complete(measurement):
            estimate = self._step()
        return estimate

    def flush(self) -> Estimate | None:
        """Solve what is pending at the end of the data."""
        return self._step() if self._cycle_start is not None else None

    def _wanted(self, name: str) -> bool:
        return name == "insertion" or getattr(self.settings, name).enabled

    def _make_tof(self, prior_map) -> TofFactor | None:
        if prior_map is None or not self.settings.tof.enabled or not self.robot.tof:
            return None
        from continuum_loc.mapping.voxel_index import VoxelIndex

        index = VoxelIndex(prior_map.points, prior_map.normals)
        return TofFactor(self.robot, self.grid, self.settings, prior_map, index)

    def _admit(self, measurement: Measurement) -> bool:
        """Put the measurement into its interval; False where it was dropped and counted."""
        if self.epoch is None:
            self._start(measurement.stamp)
        time = seconds(measurement.stamp, self.epoch)
        if time < self.columns[0].time - TIME_EPSILON:
            return self._drop("older than the window")
        used = False
        for factor in self.factors:
            if isinstance(measurement, factor.consumes):
                try:
                    row = factor.row(measurement)
                except MeasurementError as error:
                    self._drop(f"{factor.name}: {error.reason}")
                    continue
                self._interval_at(time).add(factor, time, row)
                used = True
        if used:
            self.counts["used"][type(measurement).__name__] += 1
            self.newest = max(self.newest, measurement.stamp)
            self._note_rest(measurement)
        return used

    def _drop(self, reason: str) -> bool:
        self.counts["dropped"][reason] += 1
        return False

    def _cycle_over(self, measurement: Measurement) -> bool:
        """Whether a cycle that began can wait no longer for the sensors that are missing in it."""
        if self._cycle_start is None or measurement.stamp <= self._cycle_start:
            return False
        rate = self.robot.tof_model.rate if self.tof is not None else self.settings.output_rate
        again = isinstance(measurement, TofFrame) and measurement.sensor in self._cycle
        return again or seconds(measurement.stamp, self._cycle_start) >= 1.0 / rate - TIME_EPSILON

    def _cycle_complete(self, measurement: Measurement) -> bool:
        """Note the measurement in the running cycle; True when every sensor of the last cycle has spoken."""
        if self.tof is None:
            self._cycle_start = self._cycle_start or measurement.stamp
            return False
        if isinstance(measurement, TofFrame):
            self._cycle_start = self._cycle_start or measurement.stamp
            self._cycle.add(measurement.sensor)
        return bool(self._last_cycle) and self._cycle >= self._last_cycle or len(self._cycle) == len(self.robot.tof)

    # ------------------------------------------------------------------ the window

    def _start(self, stamp: int) -> None:
        self.epoch = self.newest = stamp
        strain = np.tile(self.priors.rest, (self.grid.nodes, 1))
        self._restart(column_at_rest(self.grid, self.priors.T_map_base, strain, 0.0))

    def _restart(self, column: Column) -> None:
        self.columns, self.offsets, self.intervals = [column], [np.zeros(self.grid.dim)], []
        self.chain = Chain(self.grid.dim, self.priors.start(column))
        self._marginalised = False

    def _interval_at(self, time: float) -> Interval:
        """The interval (t_k, t_k+1] that holds `time`, with new knots appended as needed."""
        while time > self.columns[-1].time + TIME_EPSILON or not self.intervals:
            self._append_column()
        k = int(np.ceil((time - self.columns[0].time) / self.settings.knot_period - 1e-6)) - 1
        return self.intervals[min(max(k, 0), len(self.intervals) - 1)]

    def _append_column(self) -> None:
        newest = self.columns[-1].retract(self.offsets[-1])
        self.intervals.append(Interval(newest.time, self.grid.dim))
        self.columns.append(newest.predict(self.settings.knot_period))
        self.offsets.append(np.zeros(self.grid.dim))
        if self.columns[-1].time - self.columns[1].time > self.settings.window - TIME_EPSILON:
            self._marginalise_oldest()

    def _marginalise_oldest(self) -> None:
        """Drop the oldest column and keep its message; its neighbour's linearisation point is then pinned."""
        oldest = self.intervals[0]
        changed = oldest.changed
        if changed:
            oldest.linearise(self.priors, self.columns[0], self.columns[1])
        self.chain.forget_oldest(oldest.blocks, changed)
        del self.columns[0], self.offsets[0], self.intervals[0]
        self._marginalised = True

    # ------------------------------------------------------------------ one step

    def _step(self) -> Estimate | None:
        self._last_cycle, self._cycle, self._cycle_start = self._cycle, set(), None
        if not self.intervals:
            return None
        started = clock.perf_counter()
        if not self.acquired:
            self._guess_shape()
        iterations, converged = self._optimise()
        self._finish_rest()
        self.acquired = self.acquired or converged
        return self._estimate(iterations, converged, clock.perf_counter() - started)

    def _optimise(self) -> tuple[int, bool]:
        """Gauss-Newton with damping when a step raises the cost: (iterations, whether it converged)."""
        solver = self.settings.solver
        limit = solver.max_iterations if self.acquired else solver.acquisition_iterations
        damping, first = 0.0, self._linearise()
        for iteration in range(1, limit + 1):
            before = None if self.acquired else (self.columns.copy(), self.offsets.copy(), self._cost())
            try:
                offsets = self.chain.solve([interval.blocks for interval in self.intervals], first, damping)
            except SingularError:
                damping, first = max(10.0 * damping, 1e-4), 0
                if damping > 1e3:
                    raise
                continue
            move = self._largest_move(offsets)
            first = self._move(offsets)
            self._set_gate(iteration)
            first = min(first, self._linearise())
            if before is not None and self._cost() > before[2] * (1.0 + COST_SLACK) + 1.0:
                self.columns, self.offsets = before[:2]
                for interval in self.intervals:
                    interval.changed = True
                first, damping = self._linearise(), max(10.0 * damping, 1e-3)
                continue
            damping = damping / 10.0 if damping > 1e-6 else 0.0
            if move < solver.tolerance and self._gate_closed():
                return iteration, True
        return limit, False

    def _linearise(self) -> int:
        """Linearise the intervals that changed; the first of them."""
        changed = [k for k, interval in enumerate(self.intervals) if interval.changed]
        for k in changed:
            self.intervals[k].linearise(self.priors, self.columns[k], self.columns[k + 1])
        return changed[0] if changed else len(self.intervals)

    def _largest_move(self, offsets: list[np.ndarray]) -> float:
        return max(float(np.max(np.abs(self._poses(new - old)))) for new, old in zip(offsets, self.offsets, strict=True))

    def _poses(self, offset: np.ndarray) -> np.ndarray:
        return offset[:self.grid.bias_offset].reshape(-1, 18)[:, :6]

    def _move(self, offsets: list[np.ndarray]) -> int:
        """Take the offsets; columns that moved far get a new linearisation point. The first interval affected.

        The column that a marginalisation pinned keeps its point (first-estimate Jacobians).
        """
        first = len(self.intervals)
        for k, offset in enumerate(offsets):
            pinned = k == 0 and self._marginalised
            if pinned or np.max(np.abs(self._poses(offset))) < self.settings.solver.relinearise:
                self.offsets[k] = offset
                continue
            self.columns[k] = self.columns[k].retract(offset)
            self.offsets[k] = np.zeros(self.grid.dim)
            if k == 0:
                self.chain.messages[0] = self.priors.start(self.columns[0])
            for touched in (k - 1, k):
                if 0 <= touched < len(self.intervals):
                    self.intervals[touched].changed = True
                    first = min(first, touched)
        return first

    def _cost(self) -> float:
        """The window's cost: robust where linearised, by the quadratic model at the offsets."""
        start, x = self.chain.messages[0], self.offsets[0]
        total = float(x @ (start.gradient + 0.5 * (start.information @ x)))
        return total + sum(interval.modelled_cost(self.offsets[k], self.offsets[k + 1])
                           for k, interval in enumerate(self.intervals))

    # ------------------------------------------------------------------ the start

    def _guess_shape(self) -> None:
        """Start from the first strain and insertion measured, where there are any, rather than from straight."""
        column = self.columns[0]
        strain, T_base = column.strain.copy(), column.T[0]
        for factor in self.factors:
            rows = self.intervals[0].rows(factor)
            if factor.name == "strain" and rows:
                s, bending, _ = rows[0]
                order = np.argsort(s)
                for i in range(2):
                    strain[:, 4 + i] = np.interp(self.grid.s, s[order], bending[order, i])
            if factor.name == "insertion" and rows:
                T_base = rows[0][1]
        if len(self.columns) <= 3 and not self._marginalised:
            self._place(column_at_rest(self.grid, T_base, strain, column.time))

    def _place(self, column: Column) -> None:
        """Put the whole window at one motionless column."""
        for k, old in enumerate(self.columns):
            self.columns[k] = Column(old.time, column.T.copy(), column.strain.copy(), column.velocity.copy(),
                                     old.bias.copy())
            self.offsets[k] = np.zeros(self.grid.dim)
        self.chain = Chain(self.grid.dim, self.priors.start(self.columns[0]))
        for interval in self.intervals:
            interval.changed = True

    def _set_gate(self, iteration: int) -> None:
        """Wide at first, when the shape is a guess, then narrowing to the tracking gate."""
        if self.tof is None:
            return
        options = self.settings.tof
        gate = options.gate if self.acquired else max(options.gate, options.acquisition_gate * 0.75**iteration)
        if gate != self.tof.gate:
            self.tof.gate = gate
            for interval in self.intervals:
                interval.changed = True

    def _gate_closed(self) -> bool:
        return self.tof is None or self.tof.gate <= self.settings.tof.gate

    def _note_rest(self, measurement: Measurement) -> None:
        if self._rest is not None and isinstance(measurement, ImuSample):
            self._rest.setdefault(measurement.sensor, []).append(measurement.angular_velocity)

    def _finish_rest(self) -> None:
        """After the initial rest, its average rate enters as an observation of the bias."""
        options = self.settings.gyro
        if self._rest is None or seconds(self.newest, self.epoch) < options.rest_time:
            return
        rest, self._rest = self._rest, None
        if options.rest_time == 0.0 or self._marginalised:
            return
        start = self.chain.messages[0]
        for number, imu in enumerate(self.robot.imu):
            rates = np.array(rest.get(imu.name, []))
            if len(rates) < 10 or np.max(np.std(rates, axis=0)) > options.rest_rate:
                continue
            at = self.grid.bias_offset + 3 * number + np.arange(3)
            weight = len(rates) / self.robot.imu_model.gyro_sigma**2
            mean = imu.mount.T_ring_sensor[:3, :3] @ np.mean(rates, axis=0)
            start.information[at, at] += weight
            start.gradient[at] += weight * (self.columns[0].bias[number] - mean)
            self.intervals[0].changed = True

    # ------------------------------------------------------------------ the output

    def _estimate(self, iterations: int, converged: bool, elapsed: float) -> Estimate:
        now = seconds(self.newest, self.epoch)
        before = now - self.settings.lag
        lagged = None
        if self.settings.lag > 0.0 and before >= self.columns[0].time:
            lagged = self._compose(before, converged, iterations, elapsed, None)
        return self._compose(now, converged, iterations, elapsed, lagged)

    def _compose(self, time: float, converged: bool, iterations: int, elapsed: float,
                 lagged: Estimate | None) -> Estimate:
        body, covariance = self._body(time)
        rings = self.grid.ring_nodes
        squared, count, inliers = self._fit()
        return Estimate(
            stamp=self.epoch + round(time * 1e9), T_map_ring=body.T[rings], covariance=covariance[:, :6, :6],
            strain=body.strain[rings], velocity=body.velocity[rings], velocity_covariance=covariance[:, 6:, 6:],
            backbone_s=self._backbone_s,
            T_map_backbone=backbone(self.grid, body.T, body.strain, self._backbone_s),
            status="tracking" if self.acquired else "initialising", consistency=squared / max(count, 1),
            inliers=inliers, iterations=iterations, converged=converged, step_seconds=elapsed, lagged=lagged)

    def _body(self, time: float) -> tuple[Body, np.ndarray]:
        """The nodes at `time` in the window, and the covariance (R + 1, 12, 12) of each ring's [pose, velocity]."""
        k = int(np.searchsorted([column.time for column in self.columns], time - TIME_EPSILON)) - 1
        k = min(max(k, 0), len(self.intervals) - 1)
        a, b = (self.columns[i].retract(self.offsets[i]) for i in (k, k + 1))
        rings = self.grid.ring_nodes
        rows = (NODE_DIM * rings[:, None] + MOTION).ravel()
        P = self.chain.joint_covariance(k, rows)
        return body_between(a, b, time), motion_covariance(a, b, time, rings, P, np.array(self.settings.prior.velocity))

    def _fit(self) -> tuple[float, int, dict[str, float]]:
        """Squared normalised residuals and their number over the window, and the share of fitting zones by sensor."""
        squared, count = 0.0, 0
        fits: dict[str, np.ndarray] = {}
        for interval in self.intervals:
            for report in interval.reports.values():
                squared += report.squared
                count += report.count
                for sensor, fit in report.fits.items():
                    fits[sensor] = fits.get(sensor, 0.0) + fit
        return squared, count, {name: float(fit[1] / fit[0]) for name, fit in fits.items() if fit[0] > 0}
