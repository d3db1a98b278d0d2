"""One carried trial, step by step: errors of base and rings, of the frame, and what was told."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path

from continuum_loc import lie
from continuum_loc.estimate import Estimate
from continuum_loc.mapping.map_files import load_map
from continuum_loc.measurements import BaseSample, EncoderSample, NANOSECONDS, TruthSample
from continuum_loc.offline.localise import make_filter, trial_settings
from continuum_loc.offline.replay import one_thread, samples_of
from continuum_loc.offline.trial_runs import trial_map_file
from continuum_loc.offline.trials import Trial
import numpy as np

SETTLED = 0.5  # [s] of data from which on estimates are judged
NAMED = ('base', 'insertion')


@dataclass(frozen=True, eq=False)
class Followed:
    """
    K estimates of a trial with R rings, the base first.

    position [m], rotation_deg, nees (per degree of freedom): (K, R + 1). moved: (K, 6) how far
    the true base, not inserted, is from where it began. frame_position [m], frame_rotation_deg:
    (K,) of the frame of a measured base, as the base sees it. doubtful: (K,) whether base or
    encoder were named.
    """

    trial: Trial
    times: np.ndarray
    position: np.ndarray
    rotation_deg: np.ndarray
    nees: np.ndarray
    moved: np.ndarray
    frame_position: np.ndarray
    frame_rotation_deg: np.ndarray
    doubtful: np.ndarray


def followed(bag: Path, trial: Trial) -> Followed:
    """Replay a bag with what the trial's description says of the base."""
    filter_ = make_filter(
        trial.description, load_map(trial_map_file(trial)), trial_settings(trial)
    )
    truth: dict[int, np.ndarray] = {}
    mounts: dict[int, np.ndarray] = {}
    told: deque[BaseSample] = deque(maxlen=64)
    estimates: list[tuple[Estimate, BaseSample | None, float]] = []
    measured, travel, epoch = trial.description.base.mode == 'measured', 0.0, None
    with one_thread():
        for sample in samples_of(bag):
            epoch = sample.stamp if epoch is None else epoch
            if isinstance(sample, TruthSample):
                truth[sample.stamp] = sample.T_map_ring
                continue
            if isinstance(sample, EncoderSample):
                travel = float(sample.position[sample.names.index('insertion')])
            if isinstance(sample, BaseSample):
                told.append(sample)
                mounts[sample.stamp] = lie.exp(np.array([travel, 0, 0, 0, 0, 0]))
                if not measured:
                    continue
            estimate = filter_.process(sample)
            if estimate is not None and estimate.stamp > epoch + SETTLED * NANOSECONDS:
                newest = next((one for one in told if one.stamp == estimate.stamp), None)
                estimates.append((estimate, newest, travel))
    return _judged(trial, estimates, truth, mounts)


def _judged(trial: Trial, estimates: list, truth: dict, mounts: dict) -> Followed:
    stamps = np.array(sorted(truth), np.int64)
    rows, frames, first = [], [], trial.description.base.T_map_base
    for estimate, told, travel in estimates:
        true = _truth_at(stamps, truth, estimate.stamp)
        error = lie.log(lie.inverse(estimate.T_map_ring) @ true)
        nees = np.einsum('ri,rij,rj->r', error, np.linalg.inv(estimate.covariance), error) / 6.0
        mount = true[0] @ lie.exp(np.array([-travel, 0.0, 0.0, 0.0, 0.0, 0.0]))
        moved = lie.log(lie.inverse(first) @ mount)
        named = any(doubt.startswith(NAMED) for doubt in estimate.doubts)
        rows.append((estimate.stamp, error, nees, moved, named))
        if estimate.T_map_frame is not None and told is not None:
            placed = estimate.T_map_frame @ told.T_frame_base @ mounts[told.stamp]
            frames.append(lie.log(lie.inverse(true[0]) @ placed))
    stamp, error, nees, moved, named = (np.array(part) for part in zip(*rows, strict=True))
    frame = np.array(frames).reshape(-1, 6) if frames else np.full((1, 6), np.nan)
    return Followed(
        trial,
        (stamp - stamps[0]) / NANOSECONDS,
        np.linalg.norm(error[..., :3], axis=-1),
        np.degrees(np.linalg.norm(error[..., 3:], axis=-1)),
        nees,
        moved,
        np.linalg.norm(frame[:, :3], axis=1),
        np.degrees(np.linalg.norm(frame[:, 3:], axis=1)),
        named,
    )


def _truth_at(stamps: np.ndarray, truth: dict[int, np.ndarray], stamp: int) -> np.ndarray:
    """Return true poses at a stamp, along the geodesic between two of the truth's."""
    after = int(np.clip(np.searchsorted(stamps, stamp), 1, len(stamps) - 1))
    a, b = stamps[after - 1], stamps[after]
    return lie.interpolate(truth[a], truth[b], np.array((stamp - a) / (b - a)))
