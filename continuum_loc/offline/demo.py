"""
The main job end to end.

Live over ROS 2, recorded, reported, and replayed from the bag without ROS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from continuum_loc.estimator.settings import settings_of
from continuum_loc.extras import require_all
from continuum_loc.mapping.map_files import load_map
from continuum_loc.measurements import TofFrame
from continuum_loc.offline.account import account_of
from continuum_loc.offline.claims import at_least, at_most, Claim
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.metrics import errors, summarise
from continuum_loc.offline.replay import place_points, ReplayResult, samples_of
from continuum_loc.offline.replay import replay as run_replay
from continuum_loc.offline.report import context_of, write_report
from continuum_loc.offline.runs import distribution, load_run, new_run, save_run, summary_of
from continuum_loc.offline.trial_runs import configuration, trial_map_file
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.trajectory import BASE, Trajectory
import numpy as np

Tell = Callable[[str], None]


@dataclass(frozen=True)
class DemoOutcome:
    """
    Where the demo's files are, its summary, and whether two replays of its bag agreed.

    They agree when they are the same to the last bit.
    """

    folder: Path
    bag: Path
    summary: dict[str, Any]
    claims: list[Claim]
    identical: bool


def run_demo(trial: Trial, root: Path, tell: Tell = print) -> DemoOutcome:
    """Run `trial` live into a new folder under `root`, replay its bag twice, write the report."""
    from continuum_loc.offline.live import run_live

    for extra in ('simulate', 'report', 'ros'):
        require_all(extra)
    robot = load_robot(trial.robot)
    settings = settings_of(robot.name)
    tell('building the scene and its prior map (kept for the next time)')
    map_file = trial_map_file(trial)
    folder = new_run('demo', root)
    live = run_live(
        folder / 'live',
        trial,
        progress=lambda stage, share: tell(f'{stage} {100 * share:.0f} %'),
    )
    bag = (folder / 'live' / 'bag').rename(folder / 'bag')
    prior = load_map(map_file)
    replays = []
    for number in (1, 2):
        tell(f'replaying the bag without ROS, run {number} of 2')
        replays.append(run_replay(bag, make_filter(robot, prior, settings)))
    shown = with_live_poses(replays[0], recorded_track(bag, robot), bag, robot)
    shown = replace(
        shown,
        latency_seconds=np.array(live.latencies_s),
        counts={**live.counts, 'lost': live.lost},
    )
    identical = replays[0].digest == replays[1].digest
    claims = demo_claims(shown, live.lost, identical)
    counts = {
        **live.counts['filter'],
        'intake': live.counts['estimator'],
        'suspects': replays[0].counts['suspects'],  # the topics do not say
    }
    summary = save_run(
        folder,
        shown,
        kind='demo',
        seed=trial.seed,
        configuration=configuration(trial, estimator=settings, map={'file': map_file}, bag=bag),
        extra={
            'account': account_of(robot, settings, counts, summary_of(shown)),
            'claims': claims,
            'live_step_ms': live.step_ms,
            'lost_messages': live.lost,
            'replay': replay_summary(shown, replays[0], identical),
        },
    )
    tell('writing the report')
    run = load_run(folder)
    write_report(run, context_of(run))
    return DemoOutcome(folder, bag, summary, claims, identical)


def recorded_track(bag: Path, robot: RobotDescription) -> Trajectory:
    """
    Read the poses and backbones that the estimator published live, as the bag recorded them.

    There is no covariance.
    """
    from msg_tools.bag import read_bag

    poses, backbones = {}, {}
    for topic, item in read_bag(bag, topics=('poses', 'backbone')):
        if topic == 'poses':
            poses[item.stamp] = item.T_map_body
        else:
            backbones[item.stamp] = item.T_map_backbone[:, :3, 3]
    stamps = sorted(poses.keys() & backbones.keys())
    if not stamps:
        return Trajectory.empty((BASE, *robot.ring_names))
    return Trajectory(
        np.array(stamps, np.int64),
        (BASE, *robot.ring_names),
        np.stack([poses[stamp] for stamp in stamps]),
        backbone=np.stack([backbones[stamp] for stamp in stamps]),
    )


def with_live_poses(
    replayed: ReplayResult, live: Trajectory, bag: Path, robot: RobotDescription
) -> ReplayResult:
    """
    `replayed` with the poses that were published live instead of its own.

    The topic `poses` carries no covariance: covariance, status and consistency are the replay's at
    the same stamps, and instants that the replay has not are left out (their number is in the
    summary).
    """
    common, mine, theirs = np.intersect1d(live.stamps, replayed.track.stamps, return_indices=True)
    if len(common) == 0:
        return replayed
    track = Trajectory(
        common,
        live.names,
        live.T_map_ring[mine],
        replayed.track.covariance[theirs],
        replayed.track.status[theirs],
        live.backbone[mine],
    )
    frames = (item for item in samples_of(bag) if isinstance(item, TofFrame))
    return replace(
        replayed,
        track=track,
        consistency=replayed.consistency[theirs],
        cloud=place_points(_spread(frames), track, robot),
    )


def _spread(frames: Any) -> list[TofFrame]:
    """Every fourth frame of each sensor."""
    seen: dict[str, int] = {}
    kept = []
    for frame in frames:
        seen[frame.sensor] = seen.get(frame.sensor, -1) + 1
        if seen[frame.sensor] % 4 == 0:
            kept.append(frame)
    return kept


def replay_summary(live: ReplayResult, replayed: ReplayResult, identical: bool) -> dict[str, Any]:
    """Errors of the replay, and how far the live poses are from it."""
    _, mine, theirs = np.intersect1d(live.track.stamps, replayed.track.stamps, return_indices=True)
    apart = np.linalg.norm(
        live.track.T_map_ring[mine, :, :3, 3] - replayed.track.T_map_ring[theirs, :, :3, 3],
        axis=-1,
    )
    return {
        'identical': identical,
        'estimates': len(replayed.track),
        'estimates_live': len(live.track),
        'live_minus_replay_m': distribution(apart.ravel()),
        **summarise(errors(replayed.track, replayed.truth)),
    }


def demo_claims(result: ReplayResult, lost: dict[str, int], identical: bool) -> list[Claim]:
    """Judge the bounds that a live run has to keep."""
    found = summarise(errors(result.track, result.truth))
    latency = distribution(1e3 * result.latency_seconds)
    dropped = sum(sum(result.counts[node]['dropped'].values()) for node in ('estimator', 'filter'))
    return [
        at_most('translation MAE', 100 * found['translation_mae_m'], 'cm', 0.4),
        at_most('rotation MAE', found['rotation_mae_deg'], 'deg', 0.5),
        at_most('live latency p95', latency['p95'], 'ms', 66.0),
        at_most('messages lost on the way', sum(lost.values()), '', 0),
        at_most('messages dropped by the estimator', dropped, '', 0),
        at_least('replay real-time factor', result.real_time_factor, '', 2.0),
        at_least('replays identical', float(identical), '', 1.0),
    ]
