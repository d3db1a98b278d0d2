"""
Scene reconstruction and anomalies, from what the trials of Table II saw.

Against the true meshes and known anomalies.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from continuum_loc.evaluation.campaign import (
    bag_of,
    Outcome,
    parallel,
    run_campaign,
    show_progress,
)
from continuum_loc.evaluation.replay import samples_of
from continuum_loc.evaluation.runs import load_run
from continuum_loc.evaluation.studies.table2 import trials
from continuum_loc.evaluation.study import at_least, at_most, Claim, write_study
from continuum_loc.evaluation.tracks import Track
from continuum_loc.evaluation.trials import scene_map, Trial
from continuum_loc.mapping.anomalies import (
    AnomalyCluster,
    detect_anomalies,
    precision_recall,
    seen,
    Truth,
)
from continuum_loc.mapping.reconstruct import (
    reconstruct,
    Reconstruction,
    RingTrajectory,
    root_mean_square,
)
from continuum_loc.measurements import NANOSECONDS, TofFrame
from continuum_loc.robot import load_robot
from continuum_loc.simulator.scenes import load_scene
import numpy as np

THRESHOLDS = np.round(np.arange(0.0, 1.0, 0.05), 2)
LEAST_SIZE = 0.03  # m: smaller anomalies are not asked for
# Trials of one scene all begin at the same stamp: keep their instants apart.
APART = 10_000 * NANOSECONDS


@dataclass(frozen=True, eq=False)
class SceneResult:
    """
    What the trials of one scene gave.

    Points, their RMSE to the true mesh (and that of points placed by the true poses, which is the
    sensors' share), clusters, and what could be found.
    """

    scene: str
    points: int
    rmse_m: float
    rmse_true_poses_m: float
    clusters: list[AnomalyCluster]
    truth: list[Truth]
    known: int


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Localise as for Table II, then reconstruct each scene from its trials.

    Trials in `out` are not run again.
    """
    (out / 'anomalies').mkdir(parents=True, exist_ok=True)
    outcomes = run_campaign(trials(quick, seed), out, jobs)
    scenes = list(dict.fromkeys(outcome.trial.scene for outcome in outcomes))
    work = [
        (
            out,
            scene,
            [
                one.trial
                for one in outcomes
                if one.trial.scene == scene and one.summary is not None
            ],
        )
        for scene in scenes
    ]
    results = sorted(
        show_progress(parallel(judge_scene, work, jobs), len(work), 'reconstructing'),
        key=lambda result: scenes.index(result.scene),
    )
    curve = pooled_curve(results)
    claims = judge(outcomes, results, curve)
    write_study(
        out / 'anomalies',
        claims,
        seed=seed,
        settings={'trials': [one.trial for one in outcomes]},
        tables={
            'reconstruction': [row(result) for result in results],
            'precision_recall': curve,
            'clusters': cluster_rows(results),
        },
        extra={'quick': quick},
    )
    return claims


def judge_scene(out: Path, scene_name: str, members: list[Trial]) -> SceneResult:
    """
    Reconstruct from the smoothed trajectories of a scene's trials.

    Then detect what differs from the prior map.
    """
    scene = load_scene(scene_name)
    estimated = joined(
        [reconstruction_of(out, trial, number, 'lagged') for number, trial in enumerate(members)]
    )
    true = joined(
        [reconstruction_of(out, trial, number, 'truth') for number, trial in enumerate(members)]
    )
    estimated.save(out / 'anomalies' / f'{scene_name}.ply')
    wanted = [
        Truth(one.kind, one.vertices, one.faces)
        for one in scene.anomalies
        if one.size >= LEAST_SIZE
    ]
    prior = scene_map(members[0].map_scene or scene_name)
    rmse = [
        root_mean_square(one.distances_to_mesh(scene.vertices, scene.faces))
        for one in (estimated, true)
    ]
    return SceneResult(
        scene_name,
        len(estimated.points),
        *rmse,
        detect_anomalies(estimated, prior),
        seen(wanted, true),
        len(wanted),
    )


def reconstruction_of(out: Path, trial: Trial, number: int, track: str) -> Reconstruction:
    """Place the points of one trial, by its smoothed estimate (`lagged`) or by the `truth`."""
    run = load_run(out / 'trials' / trial.name)
    path: Track = getattr(run.result, track)
    frames = [sample for sample in samples_of(bag_of(out, trial)) if isinstance(sample, TofFrame)]
    trajectory = RingTrajectory(path.stamps, path.T_map_ring, path.covariance)
    found = reconstruct(load_robot(trial.robot), frames, trajectory)
    return replace(found, stamps=found.stamps + number * APART)


def joined(parts: list[Reconstruction]) -> Reconstruction:
    """Several reconstructions as one."""
    if len({part.sensors for part in parts}) != 1:
        raise ValueError('reconstructions of different robots cannot be joined')
    arrays = {
        item.name: np.concatenate([getattr(part, item.name) for part in parts])
        for item in fields(Reconstruction)
        if isinstance(getattr(parts[0], item.name), np.ndarray)
    }
    return replace(
        parts[0],
        **arrays,
        skipped=sum(part.skipped for part in parts),
        on_body=sum(part.on_body for part in parts),
    )


def pooled_curve(results: list[SceneResult]) -> list[dict[str, Any]]:
    """Precision and recall over all scenes at each threshold of confidence."""
    curves = [precision_recall(result.clusters, result.truth, THRESHOLDS) for result in results]
    kept, correct, found = (
        np.sum([getattr(curve, name) for curve in curves], axis=0)
        for name in ('kept', 'correct', 'found')
    )
    truths = sum(curve.truths for curve in curves)
    return [
        {
            'threshold': float(threshold),
            'kept': int(k),
            'correct': int(c),
            'found': int(f),
            'truths': truths,
            'precision': c / k if k else 1.0,
            'recall': f / truths if truths else float('nan'),
        }
        for threshold, k, c, f in zip(THRESHOLDS, kept, correct, found, strict=True)
    ]


def judge(
    outcomes: list[Outcome], results: list[SceneResult], curve: list[dict[str, Any]]
) -> list[Claim]:
    """RMSE of the worst scene, and the best recall reached at a precision of at least 0.9."""
    precise = [point['recall'] for point in curve if point['precision'] >= 0.9]
    return [
        at_most(
            'reconstruction RMSE, worst scene',
            100 * max(result.rmse_m for result in results),
            'cm',
            0.5,
        ),
        at_least(
            'anomalies of 3 cm and more that were seen: recall at precision 0.9',
            max(precise) if precise else 0.0,
            '',
            0.9,
        ),
        at_most('trials that failed', sum(one.summary is None for one in outcomes), '', 0),
    ]


def row(result: SceneResult) -> dict[str, Any]:
    """One scene of the table."""
    return {
        'scene': result.scene,
        'points': result.points,
        'RMSE [cm]': 100 * result.rmse_m,
        'RMSE, true poses [cm]': 100 * result.rmse_true_poses_m,
        'anomalies': result.known,
        'seen': len(result.truth),
        'clusters': len(result.clusters),
    }


def cluster_rows(results: list[SceneResult]) -> list[dict[str, Any]]:
    """Every cluster that was detected."""
    return [
        {
            'scene': result.scene,
            'kind': one.kind,
            'size [cm]': 100 * one.size,
            'confidence': one.confidence,
            'beams': one.beams,
            'frames': one.frames,
            **dict(zip('xyz', one.centre.tolist(), strict=True)),
        }
        for result in results
        for one in result.clusters
    ]
