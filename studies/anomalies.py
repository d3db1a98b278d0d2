"""Reconstruction and anomalies from what the trials of Table II saw, beside the true meshes."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from continuum_loc.mapping.map_files import load_map
from continuum_loc.measurements import NANOSECONDS, TofFrame
from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
from continuum_loc.offline.replay import samples_of
from continuum_loc.offline.runs import load_run
from continuum_loc.offline.trial_runs import trial_map_file
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot
from continuum_loc.scene.anomalies import (
    AnomalySettings,
    detect_anomalies,
    precision_recall,
    seen,
    Truth,
)
from continuum_loc.scene.fuse import fuse, FusionSettings
from continuum_loc.scene.reconstruct import (
    distances_to_mesh,
    reconstruct,
    Reconstruction,
    root_mean_square,
)
from continuum_loc.simulator.scenes import load_scene
import numpy as np
from studies._anomaly_report import write_anomaly_report
from studies._paper_figures import scene_picture
from studies._scene_result import SceneResult
from studies.support.campaign import (
    bag_of,
    Outcome,
    parallel,
    run_campaign,
    show_progress,
)
from studies.support.split import DETECTOR_HOLD_OUT, require_new_scenes
from studies.support.worlds import by_world, IDEAL, in_worlds, named, told
from studies.table2 import trials

THRESHOLDS = np.round(np.arange(0.0, 1.0, 0.05), 2)
JUDGED_POINTS = 100_000  # chosen evenly, at most: their RMSE errs by less than 1 %
SHOWN_SURFELS = 15_000  # in the report's picture of a scene
LEAST_SIZE = 0.03  # m: smaller anomalies are not asked for
# Trials of one scene all begin at the same stamp: keep their instants apart.
APART = 10_000 * NANOSECONDS


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Localise as for Table II, then reconstruct each scene from its trials.

    Trials that are in `out` already are not run again.
    """
    return run_scenes(out, out / 'anomalies', in_worlds(trials(quick, seed)), seed, jobs)


def run_scenes(
    out: Path, folder: Path, members: list[Trial], seed: int, jobs: int, tuning: bool = False
) -> list[Claim]:
    """
    Run trials in `out`, reconstruct their scenes, and write tables and reports to `folder`.

    What is seen in another world than the ideal one lies in a folder of that world.
    """
    if not tuning:
        require_new_scenes(trial.scene for trial in members)
    outcomes = run_campaign(members, out, jobs)
    claims, tables = [], {}
    for world, ones in by_world(outcomes, lambda one: one.trial).items():
        place = folder if world == IDEAL else folder / world
        place.mkdir(parents=True, exist_ok=True)
        found, made = _judge_world(out, place, ones, jobs)
        claims += told(found, world)
        tables |= {named(name, world): table for name, table in made.items()}
    write_study(
        folder,
        claims,
        seed=seed,
        settings={
            'trials': [one.trial for one in outcomes],
            'detector': AnomalySettings(),
            'fusion': FusionSettings(),
        },
        tables=tables,
        extra={
            'detector_hold_out': DETECTOR_HOLD_OUT,
            'failed': {one.trial.name: one.error for one in outcomes if one.error},
        },
    )
    return claims


def _judge_world(
    out: Path, folder: Path, outcomes: list[Outcome], jobs: int
) -> tuple[list[Claim], dict[str, list[dict[str, Any]]]]:
    """Reconstruct the scenes of one world's trials; claims and tables, and a report of both."""
    scenes = list(dict.fromkeys(outcome.trial.scene for outcome in outcomes))
    finished = [one.trial for one in outcomes if one.summary is not None]
    work = [
        (out, folder, scene, [trial for trial in finished if trial.scene == scene])
        for scene in scenes
        if any(trial.scene == scene for trial in finished)
    ]
    results = sorted(
        show_progress(parallel(judge_scene, work, jobs), len(work), 'reconstructing'),
        key=lambda result: scenes.index(result.scene),
    )
    curve = pooled_curve(results)
    claims = judge(outcomes, results, curve)
    tables = {
        'reconstruction': [row(result) for result in results],
        'precision_recall': curve,
        'clusters': cluster_rows(results),
    }
    write_anomaly_report(folder / 'report.html', claims, tables, results)
    return claims, tables


def judge_scene(out: Path, folder: Path, scene_name: str, members: list[Trial]) -> SceneResult:
    """Reconstruct from the smoothed trajectories, and detect what differs from the prior map."""
    scene = load_scene(scene_name)
    placed = [reconstructions_of(out, trial, number) for number, trial in enumerate(members)]
    estimated, true = (joined(list(parts)) for parts in zip(*placed, strict=True))
    surface = fuse(estimated)
    estimated.save(folder / f'{scene_name}_points.ply')
    surface.save(folder / f'{scene_name}.ply')
    wanted = [
        Truth(one.kind, one.vertices, one.faces)
        for one in scene.anomalies
        if one.size >= LEAST_SIZE
    ]
    off = {
        name: distances_to_mesh(points, scene.vertices, scene.faces)
        for name, points in (
            ('fused', surface.points),
            ('points', estimated.points[:: 1 + len(estimated.points) // JUDGED_POINTS]),
            ('true poses', true.points[:: 1 + len(true.points) // JUDGED_POINTS]),
        )
    }
    prior = load_map(trial_map_file(members[0]))
    clusters = detect_anomalies(estimated, prior)
    return SceneResult(
        scene=scene_name,
        points=len(estimated.points),
        surfels=len(surface.points),
        rmse_m={name: root_mean_square(distance) for name, distance in off.items()},
        covered=float(np.mean(off['fused'] <= 3.0 * surface.sigma)),
        clusters=clusters,
        truth=seen(wanted, true),
        known=len(wanted),
        fused=surface.points[:: max(1, len(surface.points) // SHOWN_SURFELS)],
        picture=scene_picture(scene, prior.points, surface.points, clusters),
    )


def reconstructions_of(out: Path, trial: Trial, number: int) -> list[Reconstruction]:
    """Place the points of one trial by its smoothed estimate, and by the truth."""
    run = load_run(out / 'trials' / trial.name)
    robot = load_robot(trial.robot)
    frames = [sample for sample in samples_of(bag_of(out, trial)) if isinstance(sample, TofFrame)]
    placed = (reconstruct(robot, frames, path) for path in (run.result.lagged, run.result.truth))
    return [replace(found, stamps=found.stamps + number * APART) for found in placed]


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
        np.reshape([getattr(curve, name) for curve in curves], (-1, len(THRESHOLDS))).sum(axis=0)
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
    """RMSE of the worst scene; precision and recall at the confidence that the hold-out gave."""
    limit = AnomalySettings().min_confidence
    point = next(point for point in curve if point['threshold'] >= limit)
    return [
        at_most(
            'reconstructed scene, RMSE of the worst',
            100 * max((result.rmse_m['fused'] for result in results), default=float('nan')),
            'cm',
            0.5,
        ),
        at_least(
            f'anomalies of 3 cm and more that were seen: recall at confidence {limit:g}',
            point['recall'],
            '',
            0.9,
        ),
        at_least(f'... precision at confidence {limit:g}', point['precision'], '', 0.9),
        at_most('trials that failed', sum(one.summary is None for one in outcomes), '', 0),
    ]


def row(result: SceneResult) -> dict[str, Any]:
    """One scene of the table."""
    return {
        'scene': result.scene,
        'RMSE [cm]': 100 * result.rmse_m['fused'],
        'within 3 sigma [%]': 100 * result.covered,
        'surfels': result.surfels,
        'RMSE of measured points [cm]': 100 * result.rmse_m['points'],
        '... by true poses [cm]': 100 * result.rmse_m['true poses'],
        'points': result.points,
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
