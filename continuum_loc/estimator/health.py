"""
Sensor health: which sensors are not to be believed, and why.

A sensor that is silent, whose clock is off, that does not fit where its kind does, or whose zones
match the map in one frame and not in the next. A ToF sensor that does not fit may be broken, or
the body be in a wrong place: the caller says when a search has ruled out the latter.
"""

from __future__ import annotations

from collections.abc import Sequence

from continuum_loc.estimator.clocks import ClockEvidence, ClockOffset, Learned
from continuum_loc.estimator.doubts import Doubts
from continuum_loc.estimator.factors import Factor, TofFactor
from continuum_loc.estimator.fit import fit_of, flicker
from continuum_loc.estimator.settings import HealthSettings
from continuum_loc.estimator.sighting import Sight, Sighting
from continuum_loc.estimator.window import Window
from continuum_loc.robot import RobotDescription
import numpy as np

HEALTHY_SHARE = 0.85  # of the median sensor's samples fit, else the body is in doubt, not a sensor
RECENT = 2  # intervals that say whether a ToF sensor fits now
VOTES = 2.7  # squared deviations over those asked for, of tests in a row
MOST_VOTES = 2.0  # of one test, however certain
MOST_SPREAD = 20.0  # of the residuals' variance over the noise's
SEEN_FOR = 1.0  # [s] that what a ToF sensor was found to see holds
MOST_BLIND = 0.5  # of the ToF sensors may be wrong, else the body is
LEARNED_FOR = 60.0  # [s] in which what is known of mounts, axes and scales counts half
KNOWN_FOR = 1.0  # [s] that what was found of the clocks holds without another test
STILL_SIGMAS = 3.0  # for a clock known to be off
NOISY, MISFIT = 'noisy', 'does not fit'


class Health:
    """
    Watches over a robot's sensors, and tells the factors how much each counts.

    reasons: why each suspect is one, by name.
    """

    def __init__(
        self,
        robot: RobotDescription,
        window: Window,
        factors: Sequence[Factor],
        settings: HealthSettings,
    ):
        self.reasons: dict[str, str] = {}
        self.told: dict[str, str] = {}  # causes that were found otherwise
        self.corrected: dict[str, float] | None = None  # clocks that are estimated [s]
        self.waiting = False  # for an explanation, before which nobody is accused of not fitting
        self._robot, self._window, self._factors, self._settings = robot, window, factors, settings
        self._heard: dict[str, float] = {}
        used = {name for factor in factors for name in factor.sensors}
        self._tof_names = [sensor.name for sensor in robot.tof if sensor.name in used]
        self._kinds = (self._tof_names, [sensor.name for sensor in robot.imu])
        self._clock_groups = self._groups()
        tof = next((one for one in factors if isinstance(one, TofFactor)), None)
        self._sighting = Sighting(robot, window, tof) if tof else None
        self._sights: dict[str, tuple[float, Sight]] = {}  # when each was judged, and how
        self._votes: dict[tuple[str, ...], float] = {}
        self._late: dict[tuple[str, ...], ClockOffset] = {}
        period = settings.clock_period
        share = min(period / window.settings.window, 1.0)
        self._learned = Learned(share, 0.5 ** (period / LEARNED_FOR))
        self._next_clocks, self._clocks_known = settings.clock_start, 0.0

    @property
    def disbelieved(self) -> set[str]:
        """Suspects whose samples tell nothing of the body; noise alone the loss deals with."""
        corrected = self.corrected or ()
        return {
            name
            for name, reason in self.reasons.items()
            if reason != NOISY and not (name in corrected and reason == _late(corrected[name]))
        }

    def hear(self, sensor: str, time: float) -> None:
        """Note that a sensor gave a usable sample at `time` [s]."""
        self._heard[sensor] = max(time, self._heard.get(sensor, time))

    def hear_of(self, doubts: Doubts) -> None:
        """Take over what causes were found, and whether more are looked for."""
        self.told, self.waiting = doubts.causes, doubts.pending

    def look(self, time: float, body_believed: bool, body_doubted: bool) -> None:
        """
        Judge every sensor.

        body_believed: a search found no better body. body_doubted: it may be in a wrong place,
        where clocks that are right do not fit either; so do they not beside a sensor that pulls
        the body off.
        """
        # Beside one that contradicts the description nobody else is judged by how it fits.
        alone = not self.told
        reasons = dict.fromkeys(self._noisy() if alone else (), NOISY)
        self._see(time, every=body_believed)
        misfits = self._misfits() if alone else []
        # One alone is wrong itself; several may be pulled off by a sensor of another kind.
        waiting = self.waiting and len(misfits) > 1
        for name in misfits:
            cause = self._sights[name][1].cause if name in self._sights else ''
            known = name in self.disbelieved or bool(cause)
            if known or not waiting and (body_believed or name not in self._tof_names):
                reasons[name] = cause or MISFIT
        fits = alone and MISFIT not in reasons.values() and self._most_fit()
        if self.corrected is not None:
            reasons |= {
                name: _late(offset)
                for name, offset in self.corrected.items()
                if name not in reasons
            }
        elif fits and not (body_doubted or self.waiting):
            self._look_at_clocks(time)
        elif time - self._clocks_known > KNOWN_FOR:
            self._late = {}
        for clock in self._late.values():
            reasons.update(dict.fromkeys(clock.sensors, _late(clock.offset)))
        reasons.update(dict.fromkeys(self._silent(time), 'silent'))
        reasons.update(self.told)
        self.reasons = reasons
        self._count()

    def _misfits(self) -> list[str]:
        """Sensors that do not fit while others of their kind do: a wrong mount, a broken part."""
        shares = fit_of(self._window.intervals).shares
        gyros = {name: shares[name] for name in self._kinds[1] if name in shares}
        healthy = gyros and np.median(list(gyros.values())) > HEALTHY_SHARE
        least = self._settings.sensor_share
        misfits = [name for name, share in gyros.items() if healthy and share < least]
        # A ToF sensor may fit badly because it sits a little off: that is none of its faults.
        blind = [name for name, (_, sight) in self._sights.items() if sight.wrong]
        return misfits + (blind if len(blind) <= MOST_BLIND * len(self._tof_names) else [])

    def _most_fit(self) -> bool:
        """Whether most ToF sensors fit as described, without which nothing is said of clocks."""
        shares = fit_of(self._window.intervals).shares
        tof = [shares[name] for name in self._tof_names if name in shares]
        return not tof or np.median(tof) > HEALTHY_SHARE

    def _see(self, time: float, every: bool) -> None:
        """Judge the ToF sensor that fits least, or all that fit badly, and forget the others."""
        if self._sighting is None:
            return
        shares = fit_of(self._window.intervals[-RECENT:]).shares  # a knocked one shows at once
        bad = [
            name for name in self._tof_names if shares.get(name, 1.0) < self._settings.sensor_share
        ]
        self._sights = {
            name: seen
            for name, seen in self._sights.items()
            if name in bad and time - seen[0] < SEEN_FOR
        }
        due = [name for name in bad if name not in self._sights]
        due.sort(key=lambda name: shares[name])
        for name in due if every else due[:1]:
            sight = self._sighting.judge(name)
            if sight is not None:
                self._sights[name] = time, sight

    def _noisy(self) -> list[str]:
        """Name sensors whose zones match the map in one frame and not in the next."""
        shares = flicker(self._window.intervals)
        return [name for name, share in shares.items() if share > self._settings.flicker_share]

    def _silent(self, time: float) -> list[str]:
        """Sensors without a usable sample for long while others of their kind speak."""
        silent = []
        for kind in self._kinds:
            ages = {name: time - self._heard.get(name, 0.0) for name in kind}
            if ages and min(ages.values()) < self._settings.silence:
                silent += [name for name, age in ages.items() if age >= self._settings.silence]
        return silent

    def _groups(self) -> list[tuple[str, ...]]:
        """Sensors that may share a clock: each alone, the ToF sensors of a ring, all of them."""
        rings = {ring.name: [] for ring in self._robot.rings}
        for sensor in self._robot.tof if self._tof_names else ():
            rings[sensor.ring].append(sensor.name)
        alone = [(name,) for kind in self._kinds for name in kind]
        together = [tuple(names) for names in (*rings.values(), self._tof_names) if names]
        return list(dict.fromkeys([*alone, *together]))

    def _look_at_clocks(self, time: float) -> None:
        """Test the clocks now and then."""
        if self._settings.clock_period <= 0.0 or time < self._next_clocks:
            return
        self._next_clocks = time + self._settings.clock_period
        weights = dict.fromkeys(self.disbelieved, self._settings.suspect_weight)
        evidence = ClockEvidence.of(self._window, self._factors, weights, self._learned)
        if np.max(evidence.spread, initial=0.0) <= MOST_SPREAD:
            self._clocks_known = time
            still = self._still_off(evidence)
            self._late = still | self._newly_off(evidence, still)
        elif time - self._clocks_known > KNOWN_FOR:
            self._late = {}  # a body that rattles says nothing of clocks

    def _still_off(self, evidence: ClockEvidence) -> dict[tuple[str, ...], ClockOffset]:
        """Look again at the clocks that were off: others say where the body is."""
        again = [evidence.outside(group, self._settings.suspect_weight) for group in self._late]
        least = 0.5 * self._settings.clock_offset
        return {
            one.sensors: one
            for one in again
            if one.sigmas > STILL_SIGMAS and abs(one.offset) > least
        }

    def _newly_off(
        self, evidence: ClockEvidence, known: dict[tuple[str, ...], ClockOffset]
    ) -> dict[tuple[str, ...], ClockOffset]:
        """
        Find more clocks that are off, in two tests in a row at least.

        What the knots miss of a motion looks like a clock for as long as that motion is in sight.
        """
        options, struck = self._settings, {name for group in known for name in group}
        others = [group for group in self._clock_groups if not struck & set(group)]
        found = evidence.offsets(others, options.clock_offset, options.clock_sigmas)
        self._votes = {
            one.group: self._votes.get(one.group, 0.0)
            + min((one.sigmas / options.clock_sigmas) ** 2, MOST_VOTES)
            for one in found
        }
        return {one.sensors: one for one in found if self._votes[one.group] >= VOTES}

    def _count(self) -> None:
        """Have disbelieved sensors count little, the measurements in the window included."""
        doubted, weight = self.disbelieved, self._settings.suspect_weight
        changed = [factor.weigh(doubted, weight) for factor in self._factors]
        if any(changed):
            self._window.mark_changed()


def _late(offset: float) -> str:
    """Say by how much a clock is off; offset: true time less stamp [s]."""
    return f'{1e3 * abs(offset):.0f} ms {"late" if offset < 0.0 else "early"}'
