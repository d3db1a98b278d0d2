"""
Numbered run folders: what was run, what came out, and everything that the report is made from.

runs/0007-replay/  configuration.yaml  summary.json  result.npz  report.html
                   trajectories/estimate_ring1.tum, lagged_ring1.tum, truth_ring1.tum, ...
runs/latest        -> 0007-replay
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
import json
import os
from pathlib import Path
import re
from typing import Any

from continuum_loc.errors import RunError
from continuum_loc.npz_files import read_arrays
from continuum_loc.offline.account import account_of
from continuum_loc.offline.as_json import plain, versions, write_json
from continuum_loc.offline.metrics import Errors, errors, longest_stretch, summarise
from continuum_loc.offline.replay import Cloud, ReplayResult
from continuum_loc.robot import RobotDescription
from continuum_loc.trajectory import associate, save_tum, Trajectory
from continuum_loc.yaml_files import read_yaml, write_yaml
import numpy as np

LOST_ERROR = 0.05  # m: a ring that is off by more is not where the filter says
TRACKS = ('track', 'lagged', 'truth')


@dataclass(frozen=True, eq=False)
class Run:
    """A run read back from its folder."""

    folder: Path
    summary: dict[str, Any]
    configuration: dict[str, Any]
    result: ReplayResult


def new_run(kind: str, root: str | Path = 'runs') -> Path:
    """Make `root/NNNN-KIND` with the next free number and point `root/latest` at it."""
    root = Path(root)
    root.mkdir(parents=True, exist_ok=True)
    while True:
        numbers = [
            int(match[1]) for path in root.iterdir() if (match := re.match(r'(\d+)-', path.name))
        ]
        folder = root / f'{max(numbers, default=0) + 1:04d}-{kind}'
        try:
            folder.mkdir()
        except FileExistsError:  # another process took the number
            continue
        point_latest_at(folder)
        return folder


def point_latest_at(folder: Path) -> None:
    """
    Let `latest` beside `folder` lead to it.

    It is replaced in one step, so that it always leads somewhere.
    """
    link = folder.parent / 'latest'
    if link.exists() and not link.is_symlink():
        raise RunError(f'{link} is in the way: it must be a link to the newest run')
    fresh = folder.parent / f'.latest-{os.getpid()}'
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(folder.name)
    os.replace(fresh, link)


def save_run(
    folder: Path,
    result: ReplayResult,
    *,
    kind: str,
    seed: int | None,
    configuration: Mapping[str, Any],
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """
    Write the run's files (all but the report) and return its summary.

    configuration: everything that the run was made from; the account in the summary asks for
    `robot` and `estimator` in it. `extra` adds keys to the summary.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    found = summary_of(result)
    robot, settings = (configuration.get(name) for name in ('robot', 'estimator'))
    if isinstance(robot, RobotDescription) and 'intake' in result.counts:
        found['account'] = account_of(robot, settings, result.counts, found)
    summary = {
        'kind': kind,
        **found,
        **(extra or {}),
        'seed': seed,
        'versions': versions(),
    }
    write_json(folder / 'summary.json', summary)
    write_yaml(plain(configuration), folder / 'configuration.yaml')
    tracks = (result.track, result.lagged, judged_truth(result))
    for track, prefix in zip(tracks, ('estimate', 'lagged', 'truth'), strict=True):
        save_tum(track, folder / 'trajectories', prefix)
    _save_result(folder / 'result.npz', result)
    return plain(summary)


def summary_of(result: ReplayResult) -> dict[str, Any]:
    """
    Sum up one run: errors (see `metrics.summarise`), speed, latency, counts.

    Estimates made before the filter had found itself (`initialising`) are counted, and not judged.
    """
    judged = settled(result.track)
    status = result.track.status
    found = errors(judged, result.truth)
    summary = {
        **summarise(found),
        'silent_seconds': silent_seconds(judged, found),
        'lagged': summarise(errors(settled(result.lagged), result.truth))
        if len(result.lagged)
        else None,
        'real_time_factor': result.real_time_factor,
        'data_seconds': result.data_seconds,
        'processing_seconds': result.processing_seconds,
        'processing_cpu_seconds': result.cpu_seconds,
        'step_ms': distribution(1e3 * result.step_seconds),
        'estimates': {
            'all': len(result.track),
            'judged': len(associate(judged, result.truth)[0]),
            **{
                name: int((status == name).sum()) if status is not None else 0
                for name in ('initialising', 'tracking', 'doubtful', 'lost')
            },
        },
        'consistency': float(np.median(result.consistency))
        if len(result.consistency)
        else float('nan'),
        'counts': result.counts,
        'digest': result.digest,
    }
    if len(result.latency_seconds):
        summary['latency_ms'] = distribution(1e3 * result.latency_seconds)
    return summary


def silent_seconds(judged: Trajectory, found: Errors) -> float:
    """
    Return the longest time [s] for which a ring was off and the filter did not say lost.

    Off: by more than LOST_ERROR.
    """
    off = found.translation_m[:, 1:].max(axis=1, initial=0.0) > LOST_ERROR
    if judged.status is not None:
        off &= ~np.isin(found.stamps, judged.stamps[judged.status == 'lost'])
    return longest_stretch(found.stamps, off)


def judged_truth(result: ReplayResult) -> Trajectory:
    """
    Return the truth at the instants that are judged; all of it where there are none.

    Other programs pair each estimate with the nearest truth, which is up to half a period away;
    given the truth at the very instants they find the figures of the summary.
    """
    stamps = np.unique(
        np.concatenate(
            [
                associate(settled(track), result.truth)[0].stamps
                for track in (result.track, result.lagged)
            ]
        )
    )
    if len(stamps) == 0:
        return result.truth
    return Trajectory(stamps, result.truth.names, result.truth.at(stamps))


def settled(track: Trajectory) -> Trajectory:
    """Find the instants at which the filter claims to know where it is, or to be lost."""
    return track if track.status is None else track.select(track.status != 'initialising')


def distribution(values: np.ndarray) -> dict[str, float]:
    """Mean, quantiles and greatest of `values` (nan when there are none)."""
    if len(values) == 0:
        return dict.fromkeys(('mean', 'p50', 'p95', 'p99', 'max'), float('nan'))
    p50, p95, p99 = np.percentile(values, [50, 95, 99])
    return {
        'mean': float(np.mean(values)),
        'p50': float(p50),
        'p95': float(p95),
        'p99': float(p99),
        'max': float(np.max(values)),
    }


def load_run(folder: str | Path) -> Run:
    """Read a run folder. Raises RunError naming the file that is missing or damaged."""
    folder = Path(folder)
    for name in ('summary.json', 'configuration.yaml', 'result.npz'):
        if not (folder / name).is_file():
            raise RunError(f'{folder} is no run folder: it has no {name}')
    return Run(
        folder.resolve(),
        _read(folder / 'summary.json', lambda path: _mapping(json.loads(path.read_text()))),
        _read(folder / 'configuration.yaml', lambda path: _mapping(read_yaml(path).data)),
        _read(folder / 'result.npz', _load_result),
    )


def _read(path: Path, read: Callable[[Path], Any]) -> Any:
    try:
        return read(path)
    except (LookupError, ValueError, TypeError, OSError, RecursionError) as error:
        raise RunError(
            f'{path}: damaged, or of another version of this package ({error})'
        ) from None


def _mapping(data: Any) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise ValueError(f'expected a mapping of keys, got {type(data).__name__}')
    return data


def _save_result(path: Path, result: ReplayResult) -> None:
    arrays: dict[str, Any] = {
        'consistency': result.consistency,
        'step_seconds': result.step_seconds,
        'latency_seconds': result.latency_seconds,
        'cloud_stamps': result.cloud.stamps,
        'cloud_points': result.cloud.points,
        'names': np.array(result.track.names),
        'processing_seconds': result.processing_seconds,
        'data_seconds': result.data_seconds,
        'cpu_seconds': result.cpu_seconds,
        'counts': json.dumps(plain(result.counts)),
    }
    for name in TRACKS:
        track = getattr(result, name)
        arrays |= {
            f'{name}_{item.name}': getattr(track, item.name)
            for item in fields(Trajectory)
            if item.name != 'names' and getattr(track, item.name) is not None
        }
    np.savez_compressed(path, **arrays)


def _load_result(path: Path) -> ReplayResult:
    data = read_arrays(path)
    names = tuple(str(name) for name in data['names'])

    def track(prefix: str) -> Trajectory:
        return Trajectory(
            names=names,
            **{
                item.name: data.get(f'{prefix}_{item.name}')
                for item in fields(Trajectory)
                if item.name != 'names'
            },
        )

    return ReplayResult(
        **{name: track(name) for name in TRACKS},
        consistency=data['consistency'],
        step_seconds=data['step_seconds'],
        processing_seconds=float(data['processing_seconds']),
        data_seconds=float(data['data_seconds']),
        cloud=Cloud(data['cloud_stamps'], data['cloud_points']),
        cpu_seconds=float(data['cpu_seconds']),
        counts=json.loads(str(data['counts'])),
        latency_seconds=data['latency_seconds'],
    )
