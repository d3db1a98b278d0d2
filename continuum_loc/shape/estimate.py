"""What the shape estimator gives: the modules' poses at one instant and a curve through them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from continuum_loc.robot import RobotDescription
from continuum_loc.shape.curves import arclength, extended, fit_curve
from continuum_loc.shape.settings import ShapeSettings
import numpy as np

Status = Literal['taring', 'tracking', 'degraded', 'faulty']
Faults = dict[str, tuple[str, ...]]  # what is wrong, by module


@dataclass(frozen=True, slots=True, eq=False)
class ShapeEstimate:
    """
    The arm at one instant; M modules base to tip, named by their rings.

    T_map_module: (M, 4, 4); T_map_base: (4, 4) of the inserted base.
    covariance: (M, 6, 6) of a right perturbation [rho; phi] (m, rad).
    curve: (C, 3) points in map from the magnet to the tip [m], at arclengths curve_s (C,) [m].
    observable: (M,) whether the module's own field fixes its position.
    bound: (M, 3) of `PositionFit`.
    yaw_sigma: (M,) [rad]; gravity never corrects yaw, so this only grows.
    faults: what is wrong, by module; empty when all is well.
    consistency: normalised misfit of the joint fit.
    """

    stamp: int
    modules: tuple[str, ...]
    T_map_module: np.ndarray
    covariance: np.ndarray
    curve: np.ndarray
    curve_s: np.ndarray
    observable: np.ndarray
    bound: np.ndarray
    yaw_sigma: np.ndarray
    status: Status
    faults: Faults
    consistency: float
    T_map_base: np.ndarray


def described(faults: Faults) -> str:
    """All faults in one line."""
    return '; '.join(f'{name}: {", ".join(texts)}' for name, texts in faults.items())


def curve_through(
    T_base_module: np.ndarray,
    T_map_base: np.ndarray,
    robot: RobotDescription,
    settings: ShapeSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (C, 3) in map and arclengths (C,), from the magnet through the modules to the tip."""
    s = robot.magnet.s
    points, tangents = np.zeros((2, len(T_base_module) + 1, 3))
    points[0, 0], points[1:] = s, T_base_module[:, :3, 3]
    tangents[0, 0], tangents[1:] = 1.0, T_base_module[:, :3, 0]
    points[:, 0] -= s
    curve = extended(
        fit_curve(points, tangents, settings.curve, settings.curve_points), robot.length - s
    )
    curve[:, 0] += s
    R, p = T_map_base[:3, :3], T_map_base[:3, 3]
    return curve @ R.T + p, arclength(curve) + s
