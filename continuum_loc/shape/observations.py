"""
Field and gravity as vector observations of a body's pose.

They are what a filter needs to use a Hall sensor or an accelerometer as a factor.

Both predict a known vector of the map in the body's frame, h = R^T w. For the right perturbation
T <- T Exp([rho; phi]) its derivative is [R^T (dw/dp) R, [h]x].
"""

from __future__ import annotations

from continuum_loc.lie import hat
from continuum_loc.robot import Magnet
from continuum_loc.shape.attitude import GRAVITY
from continuum_loc.shape.magnet import field_and_gradient, FieldModel
import numpy as np


def field_residual_and_jacobian(
    T_map_body: np.ndarray,
    magnet: Magnet,
    T_map_magnet: np.ndarray,
    measured: np.ndarray,
    earth_field: np.ndarray | tuple = (0.0, 0.0, 0.0),
    model: FieldModel = 'ring',
) -> tuple[np.ndarray, np.ndarray]:
    """
    Residual (..., 3) = R^T (B(p) + earth) - measured [T], and its Jacobian (..., 3, 6).

    By a right perturbation [rho; phi] of T_map_body (..., 4, 4).

    T_map_magnet: (4, 4) pose of the magnet's centre, its axis along x. measured: (..., 3) field
    [T] in the body's frame. earth_field: (3,) in map [T]. A saturated axis is nan in `measured`
    and in the residual: leave it out.
    """
    R_magnet = T_map_magnet[:3, :3]
    p_magnet = (T_map_body[..., :3, 3] - T_map_magnet[:3, 3]) @ R_magnet
    source, gradient = field_and_gradient(magnet, p_magnet, model)
    field_map = source @ R_magnet.T + np.asarray(earth_field, float)
    return _observe(T_map_body, field_map, R_magnet @ gradient @ R_magnet.T, measured)


def gravity_residual_and_jacobian(
    T_map_body: np.ndarray, measured: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Residual (..., 3) = R^T g - measured [m/s^2], and its Jacobian (..., 3, 6).

    Of a resting accelerometer.

    It holds while the body does not accelerate: gate it, or weight it by how far |measured|
    departs from g.
    """
    up = np.broadcast_to([0.0, 0.0, GRAVITY], (*T_map_body.shape[:-2], 3))
    return _observe(T_map_body, up, np.zeros((3, 3)), measured)


def _observe(
    T_map_body: np.ndarray,
    vector_map: np.ndarray,
    gradient_map: np.ndarray,
    measured: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    R_t = np.swapaxes(T_map_body[..., :3, :3], -1, -2)
    predicted = (R_t @ vector_map[..., None])[..., 0]
    by_position = R_t @ gradient_map @ T_map_body[..., :3, :3]
    return predicted - measured, np.concatenate([by_position, hat(predicted)], axis=-1)
