"""
A robot's `actuation` block from recordings of its motors and of its tip's position.

What is unknown: which stretch each motor's tendon ends at and to which side it pulls, its angle,
radius, offset and stiffness; the body's stiffness ratios, bending at rest and friction; how late
motors' stamps are; where base and marker are. Positions alone tell no forces: stiffness is told
against the bending stiffness of the first stretch, which stays as it was given.

First each motor is fitted alone, on the stretch of the recording in which it moves and no other
does; then all unknowns together, by Gauss-Newton over the whole recording as a chain of
equilibria (`mechanics.history`), with a prior on each.
"""

from __future__ import annotations

from dataclasses import dataclass
import warnings

from continuum_loc.actuation import BodyFriction, Tendon
from continuum_loc.mechanics.body import TendonBody
from continuum_loc.mechanics.history import follow, History, Model
from continuum_loc.offline.motor_csv import Recording
from continuum_loc.robot import Base, RobotDescription
import numpy as np
from scipy.spatial.transform import Rotation

NOISE = 0.008  # [m] of the tip, with what the model leaves out
MARKER_NOISE = 0.001  # [m] of the tip's position itself
DIFFERENCE = 1e-4  # step of a parameter, in standard deviations of its prior
MOST_ITERATIONS = 40
CONVERGED = 1e-4  # relative gain of an iteration that is the last


@dataclass(frozen=True)
class Unknown:
    """A kind of unknown: how many, their prior's mean and spread, what is known before."""

    name: str
    mean: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True, eq=False)
class Fit:
    """
    Unknowns found: in sigmas of their priors (P,), their covariance, and the description.

    error: (S, 3) of the tip [m] at the samples of the recording. cost: what was made least.
    """

    z: np.ndarray
    covariance: np.ndarray
    robot: RobotDescription
    history: History
    error: np.ndarray
    cost: float


class Identification:
    """
    The unknowns of a robot whose tendons are known by name, end and sign.

    robot: with an `actuation` block, from which the unknowns start; recording: with its motors.
    """

    def __init__(self, robot: RobotDescription, recording: Recording) -> None:
        self.robot, self.recording = robot, recording
        block = robot.actuation
        ends = block.stretches(robot.length, robot.backbone.module_ends)
        tendons, stretches = len(block.tendons), len(ends)
        self._groups = np.searchsorted(ends, [one.end - 1e-6 for one in block.tendons])
        self._order = [recording.motors.index(name) for name in block.names]
        self.unknowns = [
            _unknown('angle', tendons, 0.5),  # rad
            _unknown('offset', tendons, 0.004),  # m
            _unknown('radius', tendons, 0.1),  # log
            _unknown('stiffness', stretches, 1.0),  # log
            _unknown('rest', 2 * stretches, 2.0),  # 1/m
            _unknown('tilt', 3, 0.1),  # rad
            _unknown('place', 3, 0.01),  # m
            _unknown('marker', 3, 0.01),  # m
            _unknown('EI', stretches - 1, 0.5),  # log
            _unknown('friction', 2, 1.0),  # log of share and of bend
            _unknown('delay', 1, 0.3),  # s
        ]
        if block.EA is not None:
            self.unknowns.append(_unknown('EA', 1, 2.0))  # log
        self.sigma = np.concatenate([one.sigma for one in self.unknowns])
        self._ends = np.cumsum([len(one.sigma) for one in self.unknowns])[:-1]

    def named(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Unknowns by name, in their units, of z (P,) in sigmas."""
        parts = np.split(self.sigma * z, self._ends)
        return {one.name: part for one, part in zip(self.unknowns, parts, strict=True)}

    def described(self, z: np.ndarray) -> RobotDescription:
        """Return the description with the unknowns z (P,) put in."""
        p, robot = self.named(z), self.robot
        block, T = robot.actuation, robot.base.T_map_base
        stretches = len(p['rest']) // 2
        base = _moved(robot.base, T[:3, 3] + p['place'], p['tilt'])
        EI = np.broadcast_to(block.EI, stretches) * np.exp([0.0, *p['EI']])
        rest = np.broadcast_to(block.rest, (stretches, 2)) + p['rest'].reshape(-1, 2)
        friction = np.exp(p['friction']) * [block.friction.share, block.friction.bend]
        update = {
            'tendons': tuple(self._tendon(one, p, k) for k, one in enumerate(block.tendons)),
            'EI': tuple(EI.tolist()),
            'rest': tuple(map(tuple, rest.tolist())),
            'friction': BodyFriction.model_construct(
                share=float(friction[0]), bend=float(friction[1])
            ),
            'delay': block.delay + float(p['delay'][0]),
        }
        if 'EA' in p:
            update['EA'] = block.EA * float(np.exp(p['EA'][0]))
        return robot.model_copy(
            update={'base': base, 'actuation': block.model_copy(update=update)}
        )

    def _tendon(self, tendon: Tendon, p: dict[str, np.ndarray], k: int) -> Tendon:
        return tendon.model_copy(
            update={
                'azimuth_deg': tendon.azimuth_deg + float(np.degrees(p['angle'][k])),
                'offset': tendon.offset + float(p['offset'][k]),
                'radius': tendon.radius * float(np.exp(p['radius'][k])),
                'stiffness': tendon.stiffness * float(np.exp(p['stiffness'][self._groups[k]])),
            }
        )

    def model(self, z: np.ndarray, recording: Recording | None = None) -> Model:
        """Return what the unknowns z (P,) make of a recording's motors."""
        recording = self.recording if recording is None else recording
        robot, marker = self.described(z), self.named(z)['marker']
        body, time = TendonBody(robot), recording.time
        moved = recording.moved[:, self._order]
        late = time - robot.actuation.delay
        moved = np.stack([np.interp(late, time, one) for one in moved.T], axis=1)
        return Model(body.rod, body.tendons, body.load, body.wound(moved), body.T_map_base, marker)

    def fit(
        self, use: np.ndarray, start: np.ndarray | None = None, most: int = MOST_ITERATIONS
    ) -> Fit:
        """Fit to the samples `use` (S,); those left out are passed through as the others are."""
        z = np.zeros(len(self.sigma)) if start is None else start.copy()
        damping, tip = 1e-2, self.recording.tip
        history = self._slopes(z)
        cost = _cost(history, tip, use, z)
        for _ in range(most):
            before = cost
            H, g = _normal(history, tip, use, z)
            while damping < 1e6:
                trial = z - np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
                found = follow(self.model(trial))
                if _cost(found, tip, use, trial) < cost:
                    break
                damping *= 5.0
            else:
                break
            z, cost, damping = trial, _cost(found, tip, use, trial), max(damping / 5.0, 1e-6)
            if before - cost < CONVERGED * before:
                break
            history = self._slopes(z)
        history = self._slopes(z)
        H, _ = _normal(history, tip, use, z)
        error = history.tip - tip
        left = min(float(np.sqrt(np.mean(error[use] ** 2))) / NOISE, 1.0)
        H = (H - np.eye(len(z))) / max(left, MARKER_NOISE / NOISE) ** 2 + np.eye(len(z))
        return Fit(z, np.linalg.inv(H), self.described(z), history, error, cost)

    def _slopes(self, z: np.ndarray) -> History:
        moved = []
        for i in range(len(z)):
            trial = z.copy()
            trial[i] += DIFFERENCE
            moved.append(self.model(trial))
        return follow(self.model(z), moved, np.full(len(z), DIFFERENCE))


def _unknown(name: str, count: int, sigma: float) -> Unknown:
    return Unknown(name, np.zeros(count), np.full(count, sigma))


def _moved(base: Base, place: np.ndarray, tilt: np.ndarray) -> Base:
    """Put the base at another place (3,), turned by a rotation vector (3,) of `map`."""
    R = Rotation.from_rotvec(tilt).as_matrix() @ base.T_map_base[:3, :3]
    with warnings.catch_warnings():  # of a pitch of 90 degrees, where one angle is as good as 0
        warnings.simplefilter('ignore', UserWarning)
        angles = Rotation.from_matrix(R).as_euler('xyz', degrees=True)
    known = {name: getattr(base, name) for name in Base.model_fields}
    return Base.model_construct(
        **known | {'xyz': tuple(place.tolist()), 'rpy_deg': tuple(angles.tolist())}
    )


def _cost(history: History, tip: np.ndarray, use: np.ndarray, z: np.ndarray) -> float:
    return float(np.sum(((history.tip - tip)[use] / NOISE) ** 2) + z @ z)


def _normal(
    history: History, tip: np.ndarray, use: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    J = history.slope[use].reshape(-1, len(z)) / NOISE
    e = (history.tip - tip)[use].ravel() / NOISE
    return J.T @ J + np.eye(len(z)), J.T @ e + z
