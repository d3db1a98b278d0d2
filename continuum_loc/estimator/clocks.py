"""
Clock offsets: whether a sensor's stamps lie where its measurements do.

Were a sensor's true time stamp + tau, its residuals would be those of the body at that time. To
first order tau is one more unknown of the window's least squares, with gradient g, information h
and coupling c to the columns' offsets x. Eliminating these leaves

    information  I = h - c^T Lambda^-1 c,    tau = -(g + c^T x) / I,    variance 1 / I,

since the window is at its minimum. The test costs one forward substitution with the factors that
the chain keeps; sensors that share a clock are tested together by adding their g, h and c.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from continuum_loc.estimator.factors import ClockScores, Factor
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.tolerance import CLOCK
from continuum_loc.estimator.window import Window
import numpy as np

DISAGREE = 1.5  # standard deviations from its group's offset
MOST_OFFSET = 0.2  # [s] beyond a knot or so, residuals that are linear in time say nothing
NONE: Mapping[str, float] = {}
LEAST_INFORMATION = 1.0  # [1/s^2]: a sigma of a second says nothing


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """
    What true time less stamp is for some sensors [s], and its standard deviation [s].

    group: that was tested, of which `sensors` are those that agree.
    """

    sensors: tuple[str, ...]
    offset: float
    sigma: float
    group: tuple[str, ...] = ()

    @property
    def sigmas(self) -> float:
        """How many standard deviations the offset is from none."""
        return abs(self.offset) / self.sigma


@dataclass(frozen=True, slots=True, eq=False)
class ClockEvidence:
    """
    What a window says of its sensors' clocks, whatever their mounts, axes and scales are.

    names (S,); gradient (S,) and information (S, S) of the offsets, the columns and all else that
    a sensor may be off by eliminated; own (S, 2), gradient and information of each sensor alone
    where the body is; taken (S, S), what the body's uncertainty took of the latter; spread (S,),
    variance of what is left of the residuals over that of the noise.
    """

    names: list[str]
    gradient: np.ndarray
    information: np.ndarray
    own: np.ndarray
    taken: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(
        cls,
        window: Window,
        factors: Sequence[Factor],
        weights: Mapping[str, float],
        learned: Learned,
    ) -> ClockEvidence:
        """
        Gather it from the window's intervals and its chain.

        weights: of the sensors that do not count fully; learned: of what they are off by besides
        their clocks, which this window adds to.
        """
        unknowns = Unknowns.of(window, factors)
        taken = window.chain.quadratic(unknowns.coupling)
        x = np.array(window.offsets)
        g = unknowns.gradient + np.einsum('kdp,kd->p', unknowns.coupling, x)
        before = learned.before(window.columns[0].time, unknowns.prior)
        after = Normal(unknowns.information - taken + before.H, g + before.g)
        clocks, rest = unknowns.clocks, unknowns.rest
        learned.note(window.columns[-1].time, _without_clocks(unknowns, g, taken))
        gradient, information = _beyond_healthy(*_eliminated(after, clocks, rest))
        own = [
            _alone(unknowns, g, before, number, weights.get(name, 1.0))
            for number, name in enumerate(unknowns.names)
        ]
        by_body = taken[np.ix_(clocks, clocks)]
        own = np.array(own).reshape(-1, 2)
        return cls(unknowns.names, gradient, information, own, by_body, unknowns.spread)

    def offsets(
        self, groups: Sequence[tuple[str, ...]], least: float, sigmas: float
    ) -> list[ClockOffset]:
        """
        Find the groups whose clocks are off by at least `least` [s] and `sigmas` sigmas.

        One wrong clock drags the body along, so that its neighbours' seem wrong too: the most
        certain offset is taken first, and eliminated before the others are looked at again. One
        that is certain only because its residuals exceed their noise, or larger than any that the
        first order describes, is eliminated and not told.
        """
        g, information = self.gradient, self.information
        found: list[ClockOffset] = []
        left = list(groups)
        while left:
            best = max((self._solve(one, g, information) for one in left), key=_sigmas)
            if best.sigmas < sigmas or abs(best.offset) < least:
                break
            member = self._members(best.sensors)
            coupled = information @ member
            inflation = np.sqrt(max(member @ self.spread / member.sum(), 1.0))
            if best.sigmas >= sigmas * inflation and abs(best.offset) <= MOST_OFFSET:
                sensors = self._agreeing(best, g, information)
                sigma = best.sigma * inflation
                found.append(ClockOffset(sensors, best.offset, sigma, best.sensors))
            g = g + coupled * best.offset
            information = information - np.outer(coupled, coupled) * best.sigma**2
            left.remove(best.sensors)
        return found

    def _agreeing(
        self, clock: ClockOffset, g: np.ndarray, information: np.ndarray
    ) -> tuple[str, ...]:
        """Leave out the members of a group that clearly fit better with no offset of their own."""
        alone = [self._solve((name,), g, information) for name in clock.sensors]
        agreeing = [
            one.sensors[0]
            for one in alone
            if not abs(one.offset) < abs(one.offset - clock.offset) > DISAGREE * one.sigma
        ]
        return tuple(agreeing) or clock.sensors

    def outside(self, group: tuple[str, ...], weight: float) -> ClockOffset:
        """
        Estimate the offset of sensors that count with a small `weight`, so that others say where.

        The body, which does not follow them, adds its own uncertainty to that of the residuals.
        """
        member = self._members(group)
        gradient, own = member @ self.own
        taken = member @ self.taken @ member / weight**2
        if own < LEAST_INFORMATION:
            return ClockOffset(group, 0.0, np.inf)
        return ClockOffset(group, float(-gradient / own), float(np.sqrt(own + taken) / own))

    def _members(self, group: tuple[str, ...]) -> np.ndarray:
        return np.array([name in group for name in self.names], float)

    def _solve(
        self, group: tuple[str, ...], g: np.ndarray, information: np.ndarray
    ) -> ClockOffset:
        """Solve for one group's offset as if it were the only one."""
        member = self._members(group)
        total = member @ information @ member
        if total < LEAST_INFORMATION:
            return ClockOffset(group, 0.0, np.inf)
        return ClockOffset(group, float(-member @ g / total), float(total**-0.5))


def _sigmas(clock: ClockOffset) -> float:
    return clock.sigmas


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """
    All P that a window's sensors may be off by: equations, coupling and prior.

    names (S,); first (S + 1,): where each sensor's begin, its clock before its tolerances.
    gradient (P,), information (P, P), coupling (K, D, P) with the columns, prior (P,) information
    of the tolerances, 0 of the clocks; spread (S,).
    """

    names: list[str]
    first: np.ndarray
    gradient: np.ndarray
    information: np.ndarray
    coupling: np.ndarray
    prior: np.ndarray
    spread: np.ndarray

    @property
    def clocks(self) -> np.ndarray:
        """Rows of the clocks."""
        return self.first[:-1]

    @property
    def rest(self) -> np.ndarray:
        """Rows of all others."""
        return np.setdiff1d(np.arange(self.first[-1]), self.clocks)

    @classmethod
    def of(cls, window: Window, factors: Sequence[Factor]) -> Unknowns:
        """Sum up what the factors tell in each interval."""
        parts: dict[Factor, list[tuple[int, ClockScores]]] = {}
        for k, interval in enumerate(window.intervals):
            for factor in factors:
                scores = interval.clock_scores(factor, window.columns[k], window.columns[k + 1])
                if scores is not None:
                    parts.setdefault(factor, []).append((k, scores))
        names = [name for factor in parts for name in factor.sensors]
        sizes = [1 + len(factor.tolerances) for factor in parts for _ in factor.sensors]
        first = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        dim = window.grid.dim
        g, h = np.zeros(first[-1]), np.zeros((first[-1], first[-1]))
        C, spread = np.zeros((len(window.columns), dim, first[-1])), np.zeros(len(names))
        sensor = 0
        for factor, told in parts.items():
            count, size = len(factor.sensors), 1 + len(factor.tolerances)
            at = slice(first[sensor], first[sensor + count])
            for k, scores in told:
                g[at] += scores.gradient.ravel()
                C[k, :, at] += scores.coupling[:dim].reshape(dim, -1)
                C[k + 1, :, at] += scores.coupling[dim:].reshape(dim, -1)
            blocks = sum(scores.information for _, scores in told)
            for number in range(count):
                own = slice(first[sensor + number], first[sensor + number] + size)
                h[own, own] = blocks[number]
            members = slice(sensor, sensor + count)
            spread[members] = np.mean([one.spread for _, one in told], axis=0)
            sensor += count
        prior = [np.r_[0.0, f.tolerances**-2.0] for f in parts for _ in f.sensors]
        return cls(names, first, g, h, C, np.concatenate(prior or [np.empty(0)]), spread)


class Learned:
    """
    What windows that have passed say of mounts, axes and scales.

    These stay as they are, so that what one window cannot tell from a clock another can. share:
    of a window that each note stands for.
    """

    def __init__(self, share: float, keep: float):
        self._share, self._keep = share, keep
        self._sum: Normal | None = None
        self._waiting: deque[tuple[float, Normal]] = deque()

    def before(self, time: float, prior: np.ndarray) -> Normal:
        """Say what was known before `time` [s], with a prior (P,) of information."""
        while self._waiting and self._waiting[0][0] <= time:
            _, told = self._waiting.popleft()
            if self._sum is None or self._sum.H.shape != told.H.shape:
                self._sum = Normal.zeros(len(told.g))
            H = self._keep * self._sum.H + self._share * told.H
            self._sum = Normal(H, self._keep * self._sum.g + self._share * told.g)
        known = self._sum
        if known is None or known.g.shape != prior.shape:
            return Normal(np.diag(prior), np.zeros(len(prior)))
        return Normal(np.diag(prior) + known.H, known.g)

    def note(self, time: float, told: Normal) -> None:
        """Keep what a window up to `time` [s] told, until it has passed."""
        self._waiting.append((time, told))


def _eliminated(
    normal: Normal, clocks: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Equations of the clocks alone, with the rest eliminated."""
    H, g = normal
    right = np.column_stack([H[np.ix_(rest, clocks)], g[rest]])
    solved = np.linalg.solve(H[np.ix_(rest, rest)], right)
    outer = H[np.ix_(clocks, rest)]
    return g[clocks] - outer @ solved[:, -1], H[np.ix_(clocks, clocks)] - outer @ solved[:, :-1]


def _without_clocks(unknowns: Unknowns, g: np.ndarray, taken: np.ndarray) -> Normal:
    """Equations of the rest alone, the clocks taken for healthy ones; the clocks' are zero."""
    H, clocks, rest = unknowns.information - taken, unknowns.clocks, unknowns.rest
    healthy = H + np.diag(np.where(np.isin(np.arange(len(g)), clocks), CLOCK**-2.0, 0.0))
    told = Normal.zeros(len(g))
    told.g[rest], told.H[np.ix_(rest, rest)] = _eliminated(Normal(healthy, g), rest, clocks)
    return told


def _beyond_healthy(g: np.ndarray, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equations of what clocks are off by beyond what those of healthy sensors are."""
    taken = np.linalg.solve(H + np.eye(len(H)) / CLOCK**2, np.column_stack([H, g]))
    return g - H @ taken[:, -1], H - H @ taken[:, :-1]


def _alone(
    unknowns: Unknowns, g: np.ndarray, before: Normal, number: int, weight: float
) -> tuple[float, float]:
    """Gradient and information of one clock where the body is, as if the sensor counted fully."""
    own = slice(unknowns.first[number], unknowns.first[number + 1])
    clock, rest = np.array([0]), np.arange(1, own.stop - own.start)
    H = unknowns.information[own, own] / weight + before.H[own, own]
    gradient, information = _eliminated(Normal(H, g[own] / weight + before.g[own]), clock, rest)
    return float(gradient[0]), float(information[0, 0])
