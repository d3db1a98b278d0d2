"""
Errors of an estimated track against truth: size (MAE, RMSE) and honesty (NEES, coverage).

Translation error is |p_est - p_true|, rotation error the angle of R_est^T R_true. The pose error
that consistency is judged by is the right perturbation xi = Log(T_est^-1 T_true), 6 degrees of
freedom per pose, whose covariance is the estimate's; NEES = xi^T P^-1 xi, and a pose is covered
when NEES <= chi2(0.95, 6).
"""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc import lie
from continuum_loc.measurements import NANOSECONDS
from continuum_loc.trajectory import associate, Trajectory
import numpy as np
from scipy.stats import chi2

DOF = 6
COVERAGE_BOUND = float(chi2.ppf(0.95, DOF))


@dataclass(frozen=True, eq=False)
class Errors:
    """
    Errors at K instants of the base and R rings (the base first, as in `Trajectory`).

    translation_m, rotation_deg: (K, R + 1).
    pose: (K, R + 1, 6) xi = Log(T_est^-1 T_true), [rho; phi], m and rad.
    sigma: (K, R + 1, 6) standard deviation of each component of xi; nan without a covariance.
    nees: (K, R + 1); nan where the covariance is absent or not positive definite.
    """

    stamps: np.ndarray
    names: tuple[str, ...]
    translation_m: np.ndarray
    rotation_deg: np.ndarray
    pose: np.ndarray
    sigma: np.ndarray
    nees: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps)


def errors(estimate: Trajectory, truth: Trajectory) -> Errors:
    """Errors of `estimate` wherever `truth` is known (see `tracks.associate`)."""
    matched, reference = associate(estimate, truth)
    pose = lie.log(lie.inverse(matched.T_map_ring) @ reference.T_map_ring)
    offset = matched.T_map_ring[..., :3, 3] - reference.T_map_ring[..., :3, 3]
    covariance = matched.covariance
    if covariance is None:
        covariance = np.full((*pose.shape, DOF), np.nan)
    with np.errstate(invalid='ignore'):  # a negative variance gives nan, which `nees` reports
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return Errors(
        stamps=matched.stamps,
        names=matched.names,
        translation_m=np.linalg.norm(offset, axis=-1),
        rotation_deg=np.degrees(np.linalg.norm(pose[..., 3:], axis=-1)),
        pose=pose,
        sigma=sigma,
        nees=nees(pose, covariance),
    )


def nees(pose_error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """
    (...,) xi^T P^-1 xi of errors (..., n) with covariances (..., n, n).

    nan where P is not positive definite.
    """
    usable = np.isfinite(covariance).all(axis=(-2, -1))
    safe = np.where(usable[..., None, None], covariance, np.eye(covariance.shape[-1]))
    usable &= np.linalg.eigvalsh(safe)[..., 0] > 0.0
    safe = np.where(usable[..., None, None], safe, np.eye(covariance.shape[-1]))
    solved = np.linalg.solve(safe, pose_error[..., None])[..., 0]
    return np.where(usable, np.sum(pose_error * solved, axis=-1), np.nan)


def summarise(found: Errors) -> dict:
    """
    Figures over all rings, and for each ring alone.

    The base is fixed by its mount, so it is reported apart.

    Keys: translation_mae_m, translation_rmse_m, rotation_mae_deg, rotation_rmse_deg, each with
    `_std` of the error, nees_per_dof, coverage_95, `rings` and `base` with the same keys.
    """
    return {
        **_figures(found, slice(1, None)),
        'poses': int(found.translation_m[:, 1:].size),
        'rings': {
            name: _figures(found, index) for index, name in enumerate(found.names) if index > 0
        },
        'base': _figures(found, 0),
    }


def _figures(found: Errors, columns: int | slice) -> dict[str, float]:
    translation, rotation = found.translation_m[:, columns], found.rotation_deg[:, columns]
    if translation.size == 0:
        return dict.fromkeys(FIGURES, float('nan'))
    normalised = found.nees[:, columns]
    known = np.isfinite(normalised)
    # A covariance that is no covariance covers nothing: it stays in the denominator.
    coverage = (
        float(np.mean(known & (normalised <= COVERAGE_BOUND))) if known.any() else float('nan')
    )
    return {
        'translation_mae_m': float(translation.mean()),
        'translation_rmse_m': _rms(translation),
        'translation_std_m': float(translation.std()),
        'translation_max_m': float(translation.max()),
        'rotation_mae_deg': float(rotation.mean()),
        'rotation_rmse_deg': _rms(rotation),
        'rotation_std_deg': float(rotation.std()),
        'rotation_max_deg': float(rotation.max()),
        'nees_per_dof': float(normalised[known].mean() / DOF) if known.any() else float('nan'),
        'coverage_95': coverage,
        'invalid_covariances': int((~known).sum()),
    }


def longest_stretch(stamps: np.ndarray, flags: np.ndarray) -> float:
    """Return the longest time [s] over which `flags` (K,) stay true; 0 for a single instant."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    starts, ends = edges.reshape(-1, 2).T
    return float(np.max(stamps[ends - 1] - stamps[starts], initial=0)) / NANOSECONDS


FIGURES = (
    'translation_mae_m',
    'translation_rmse_m',
    'translation_std_m',
    'translation_max_m',
    'rotation_mae_deg',
    'rotation_rmse_deg',
    'rotation_std_deg',
    'rotation_max_deg',
    'nees_per_dof',
    'coverage_95',
    'invalid_covariances',
)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def drift_band(found: Errors, ring: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Three standard deviations of a ring's translation [m] and rotation [deg], each (K,).

    They are the root of the summed variances, which bounds every direction.
    """
    variance = found.sigma[:, ring] ** 2
    return (
        3.0 * np.sqrt(variance[:, :3].sum(axis=1)),
        3.0 * np.degrees(np.sqrt(variance[:, 3:].sum(axis=1))),
    )
