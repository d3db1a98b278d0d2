"""
Sensor health: which sensors are not to be believed, and why.

A sensor that is silent, whose clock is off, that does not fit where its kind does, or whose zones
match the map in one frame and not in the next. A ToF sensor that does not fit may be broken, or
the body be in a wrong place: the caller says when a search has ruled out the latter.
"""

from __future__ import annotations

from collections.abc import Sequence

from continuum_loc.estimator.clocks import ClockEvidence, ClockOffset
from continuum_loc.estimator.doubts import Doubts
from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.fit import fit_of, flicker
from continuum_loc.estimator.settings import HealthSettings
from continuum_loc.estimator.window import Window
from continuum_loc.robot import RobotDescription
import numpy as np

HEALTHY_SHARE = 0.85  # of the median sensor's samples fit, else the body is in doubt, not a sensor
RECENT = 2  # intervals that say whether a ToF sensor fits now
CERTAIN = 2.0  # times the deviations asked for, and one test will do
MOST_SPREAD = 20.0  # of the residuals' variance over the noise's
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
        self._votes: dict[tuple[str, ...], int] = {}
        self._late: dict[tuple[str, ...], ClockOffset] = {}
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
        reasons = dict.fromkeys(self._noisy(), NOISY)
        misfits = self._misfits()
        # One alone is wrong itself; several may be pulled off by a sensor of another kind.
        waiting = self.waiting and len(misfits) > 1
        for name in misfits:
            known = name in self.disbelieved
            if known or not waiting and (body_believed or name not in self._tof_names):
                reasons[name] = MISFIT
        if self.corrected is not None:
            reasons |= {
                name: _late(offset)
                for name, offset in self.corrected.items()
                if name not in reasons
            }
        elif not (body_doubted or self.waiting or MISFIT in reasons.values()):
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
        intervals, misfits = self._window.intervals, []
        shares = fit_of(intervals).shares
        recent = fit_of(intervals[-RECENT:]).shares  # a knocked ToF sensor shows at once
        shares |= {name: recent[name] for name in self._tof_names if name in recent}
        for kind in self._kinds:
            names = [name for name in kind if name in shares]
            healthy = names and np.median([shares[name] for name in names]) > HEALTHY_SHARE
            misfits += [
                name for name in names if healthy and shares[name] < self._settings.sensor_share
            ]
        return misfits

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
        evidence = ClockEvidence.of(self._window, self._factors)
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
        """Find more clocks that are off: very certainly, or twice in a row."""
        options, struck = self._settings, {name for group in known for name in group}
        others = [group for group in self._clock_groups if not struck & set(group)]
        found = evidence.offsets(others, options.clock_offset, options.clock_sigmas)
        votes = {}
        for one in found:
            certain = one.sigmas >= CERTAIN * options.clock_sigmas
            votes[one.sensors] = self._votes.get(one.sensors, 0) + (2 if certain else 1)
        self._votes = votes
        return {one.sensors: one for one in found if votes[one.sensors] >= 2}

    def _count(self) -> None:
        """Have disbelieved sensors count little, the measurements in the window included."""
        doubted, weight = self.disbelieved, self._settings.suspect_weight
        changed = [factor.weigh(doubted, weight) for factor in self._factors]
        if any(changed):
            self._window.mark_changed()


def _late(offset: float) -> str:
    """Say by how much a clock is off; offset: true time less stamp [s]."""
    return f'{1e3 * abs(offset):.0f} ms {"late" if offset < 0.0 else "early"}'
