"""From attitudes and fields at one stamp to poses: eq. 10 by module, or all modules jointly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from continuum_loc.robot import RobotDescription
from continuum_loc.shape.backbone import BackboneFit, BackboneSolver, MAX_ITERATIONS
from continuum_loc.shape.base_motion import BaseMotion
from continuum_loc.shape.calibration import Calibration, straight_modules
from continuum_loc.shape.modules import Module
from continuum_loc.shape.position import PositionSolver
from continuum_loc.shape.settings import ShapeSettings
import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """
    All M modules at one stamp.

    good: (M,) which of them may be used. R_base_module: (M, 3, 3), with covariance attitude
    (M, 3, 3) in base axes [rad^2]. field_base: (M, 3) total fields, and earth (3,), in the base
    frame [T].
    """

    stamp: int
    good: np.ndarray
    R_base_module: np.ndarray
    field_base: np.ndarray
    earth: np.ndarray
    attitude: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class ModulePoses:
    """
    Poses (M, 4, 4) with covariance (M, 6, 6); bound (M, 3) of `PositionFit`.

    observable: (M,) whether the module's own field fixes its position; ambiguous: (M,) whether
    another position fits as well.
    """

    T_base_module: np.ndarray
    covariance: np.ndarray
    bound: np.ndarray
    observable: np.ndarray
    ambiguous: np.ndarray


class PoseSolver:
    """Both ways to solve, with what follows from one calibration of `robot`."""

    def __init__(
        self,
        robot: RobotDescription,
        calibration: Calibration,
        settings: ShapeSettings,
        base: BaseMotion,
    ) -> None:
        magnet = robot.magnet.model_copy(update={'remanence': calibration.remanence})
        s = straight_modules(robot)[:, 0, 3]
        self._base, self._earth_map = base, calibration.earth_field
        self._sigma, self._left = robot.hall_model.sigma, calibration.mounting_sigma
        self._mounting = (self._left**2 + base.variance) * np.eye(3)
        self._magnet_at = np.array([magnet.s, 0.0, 0.0])
        self._positions = PositionSolver(magnet, s - magnet.s, settings.field_model)
        self._backbone = BackboneSolver(
            robot.model_copy(update={'magnet': magnet}), s, settings.field_model
        )

    def snapshot(self, modules: Sequence[Module], good: np.ndarray, stamp: int) -> Snapshot:
        """Bring all modules to one stamp. The field of a module that is not `good` is left out."""
        R_base_map = self._base.rotation(stamp).T
        attitude = np.stack([module.attitude.covariance for module in modules])
        fields = [m.field_base if good[m.place] else np.zeros(3) for m in modules]
        return Snapshot(
            stamp,
            good,
            np.stack([module.R_base_module(stamp) for module in modules]),
            np.stack(fields),
            R_base_map @ self._earth_map,
            R_base_map @ attitude @ R_base_map.T + self._mounting,
        )

    def joint(self, now: Snapshot, iterations: int = MAX_ITERATIONS) -> BackboneFit:
        """Fit all modules jointly, those that are not good by their neighbours alone."""
        R, good = now.R_base_module, now.good
        in_module = np.einsum('mji,mj->mi', R, now.field_base)
        # What the calibration leaves in the mounts turns every field, beside the sensor's own
        # noise.
        turned = np.linalg.norm(in_module, axis=1, keepdims=True) * self._left
        sigma = np.where(good[:, None], np.hypot(self._sigma, turned), np.inf).repeat(3, axis=1)
        information = np.where(
            good[:, None, None], R.swapaxes(1, 2) @ np.linalg.inv(now.attitude) @ R, 0.0
        )
        return self._backbone.solve(in_module, sigma, now.earth, R, information, iterations)

    def jointly(self, now: Snapshot, joint: BackboneFit) -> ModulePoses:
        """Take all poses from the joint fit."""
        none = np.zeros(len(now.good), bool)
        bound = np.zeros((len(now.good), 3), int)
        return ModulePoses(joint.T_base_module, joint.covariance, bound, now.good, none)

    def by_module(
        self, now: Snapshot, prior: np.ndarray, joint: BackboneFit | None
    ) -> ModulePoses:
        """
        Eq. 10 for the good modules, the joint fit's pose for the others.

        prior: (M, 4, 4) earlier poses to start from where there is no joint fit.
        """
        source = now.field_base - now.earth
        start = (prior if joint is None else joint.T_base_module)[:, :3, 3] - self._magnet_at
        if joint is not None:
            # A module left out solves for the field of its own prior, which changes nothing.
            source = np.where(now.good[:, None], source, self._positions.field(start))
        fit = self._positions.solve(source, start)
        own, observable = self._positions.covariance(
            fit.position, source, self._sigma, now.attitude
        )
        R = now.R_base_module
        T = np.zeros((len(R), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, fit.position + self._magnet_at, 1.0
        to_body = np.zeros_like(own)
        to_body[:, :3, :3] = to_body[:, 3:, 3:] = R.swapaxes(1, 2)
        covariance = to_body @ own @ to_body.swapaxes(1, 2)
        if joint is not None:
            bad = ~now.good
            T[bad], covariance[bad] = joint.T_base_module[bad], joint.covariance[bad]
        return ModulePoses(
            T, covariance, fit.bound, observable & now.good, fit.ambiguous & now.good
        )
