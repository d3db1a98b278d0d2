"""A robot description as elements and tendons: where the `actuation` block meets the statics."""

from __future__ import annotations

from continuum_loc.actuation import Actuation
from continuum_loc.mechanics.statics import (
    equilibrium,
    Load,
    new_balance,
    no_load,
    paths,
    Rod,
    slide,
    Tendons,
)
from continuum_loc.robot import RobotDescription
import numpy as np

MOST_ELEMENT = 1.0 / 12.0  # of the length, where the body has a weight


class TendonBody:
    """
    The body of a robot with an `actuation` block, cut where tendons and modules end.

    Without weight bending is constant between them, so that a stretch is one element; with weight
    an element is no longer than a twelfth of the body. Or it is cut at `cuts` (N + 1,) [m], and an
    element is of the stretch that its middle lies in. s: (N,) middles of the elements [m].
    """

    def __init__(self, robot: RobotDescription, cuts: np.ndarray | None = None) -> None:
        block = robot.actuation
        self.actuation, self.T_map_base = block, robot.base.T_map_base
        ends = block.stretches(robot.length, robot.backbone.module_ends)
        if cuts is None:
            cuts = _cuts(ends, robot.length * (MOST_ELEMENT if any(block.weight) else 1.0))
        spans = np.diff(cuts)
        self.s = 0.5 * (cuts[1:] + cuts[:-1])
        self.rod = _rod(block, spans, np.searchsorted(ends, self.s - 1e-9))
        self.tendons = _tendons(block, spans)
        self.load = Load(*no_load(len(spans))[:2], np.array(block.weight))

    def pulled(self, motors: np.ndarray) -> Tendons:
        """Tendons with the motors at `motors` (M,), positions [m] or tensions [N]."""
        if self.actuation.mode == 'tension':
            return self.tendons._replace(tension=np.maximum(motors, 0.0))
        return self.tendons._replace(taken=self.wound(motors))

    def wound(self, positions: np.ndarray) -> np.ndarray:
        """Length (..., M) wound up beyond just taut, at motor positions (..., M) [m]."""
        tendons = self.actuation.tendons
        sign = np.array([tendon.sign for tendon in tendons], float)
        return sign * positions + np.array([tendon.offset for tendon in tendons])


class BodyState:
    """The equilibrium of a body as its motors move: warm, with the memory of its friction."""

    def __init__(self, body: TendonBody) -> None:
        self.body = body
        self.strain = body.rod.rest.copy()
        self._memory = body.rod.rest[:, 2:].copy()
        self.balance = new_balance(len(body.s), len(body.actuation.tendons))
        self.balance.T[0] = body.T_map_base

    def move(self, motors: np.ndarray) -> bool:
        """Take the motors' new state (M,); False where no equilibrium was found."""
        body = self.body
        reached = equilibrium(
            body.rod, body.pulled(motors), body.load, self._memory, self.strain, self.balance
        )
        if reached:
            slide(body.rod, self.strain, self._memory)
        return bool(reached)


def _cuts(ends: np.ndarray, longest: float) -> np.ndarray:
    """(N + 1,) arclengths that cut stretches which end at `ends` into pieces of equal length."""
    edges = np.concatenate([[0.0], ends])
    parts = np.ceil(np.diff(edges) / longest - 1e-9).astype(int)
    pieces = [
        np.linspace(a, b, count, endpoint=False)
        for a, b, count in zip(edges, ends, parts, strict=False)
    ]
    return np.concatenate([*pieces, ends[-1:]])


def _rod(block: Actuation, spans: np.ndarray, stretch: np.ndarray) -> Rod:
    """Build the rod whose elements are parts of the stretches `stretch` (N,)."""
    EI = np.array(block.EI)[stretch if len(block.EI) > 1 else 0 * stretch]
    stiffness = np.column_stack(
        [
            np.full(len(spans), np.inf if block.EA is None else block.EA),
            np.full(len(spans), np.inf if block.GJ is None else block.GJ),
            EI,
            EI,
        ]
    )
    rest = np.zeros((len(spans), 4))
    rest[:, 2:] = np.array(block.rest)[stretch if len(block.rest) > 1 else 0 * stretch]
    share, bend = block.friction.share, block.friction.bend
    return Rod(spans, stiffness, rest, np.column_stack([share * EI, share * EI * bend]))


def _tendons(block: Actuation, spans: np.ndarray) -> Tendons:
    route = paths(
        spans,
        np.array([tendon.end for tendon in block.tendons]),
        np.radians([tendon.azimuth_deg for tendon in block.tendons]),
        np.array([tendon.radius for tendon in block.tendons]),
    )
    stiffness = np.array([tendon.stiffness for tendon in block.tendons])
    if block.mode == 'tension':
        stiffness = np.zeros(len(stiffness))
    return Tendons(route, stiffness, np.zeros(len(stiffness)), np.zeros(len(stiffness)))
