"""
The paper's pictures of what was estimated, as parts of a report.

Side by side with the truth (its Figs. 4 and 6: the median trial; 8: the three worst), and scenes
beside their prior map, their reconstruction (5 and 7) and what was found to differ (9). Where
there are trials in the disturbed world, those are shown.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import replace
import io
from pathlib import Path

from continuum_loc.offline.metrics import errors
from continuum_loc.offline.parallel import Outcome
from continuum_loc.offline.pictures import camera_on, dots, Painter
from continuum_loc.offline.report import context_of, Part
from continuum_loc.offline.runs import load_run
from continuum_loc.scene.anomalies import AnomalyCluster, AnomalySettings
from continuum_loc.simulator.render import Camera, render, scene_shapes, Shape
from continuum_loc.simulator.scene import Scene
import numpy as np
from studies.support.worlds import IDEAL

WORST = 3
MOST_POINTS = 20_000  # of a cloud that is drawn
POINT = 0.006  # m, radius of one
DEPTHS = 8  # shades of a cloud by its depth
NEAR, FAR = np.array([0.99, 0.91, 0.15]), np.array([0.27, 0.01, 0.33])  # as viridis begins, ends
GREY, RED = (0.62, 0.69, 0.77), (0.85, 0.1, 0.08)
CUT_AWAY = 0.35  # share of what was seen that would hide the rest
GAP = 6  # pixels


def side_by_side(out: Path, outcomes: Sequence[Outcome]) -> list[Part]:
    """Draw the median trial at its middle, and the worst where they are worst."""
    known = [one for one in outcomes if one.summary and one.summary['translation_mae_m']]
    elsewhere = [one for one in known if one.trial.world != IDEAL]
    ranked = sorted(elsewhere or known, key=lambda one: one.summary['translation_mae_m'])
    if not ranked:
        return []
    median, worst = ranked[len(ranked) // 2], ranked[-WORST:][::-1]
    return [
        Part(
            'Side by side: the median trial',
            f'As Figs. 4 and 6 of the paper: {_told(median)}.',
            figure=html(_instant(out, median, worst=False)),
        ),
        *(
            Part(
                f'Side by side: number {number} of the worst trials',
                f'As Fig. 8 of the paper, at its worst instant: {_told(one)}.',
                figure=html(_instant(out, one, worst=True)),
            )
            for number, one in enumerate(worst, start=1)
        ),
    ]


def _told(outcome: Outcome) -> str:
    summary = outcome.summary
    return (
        f'{outcome.trial.name}, {100.0 * summary["translation_mae_m"]:.2f} cm and '
        f'{summary["rotation_mae_deg"]:.2f} deg on average'
    )


def _instant(out: Path, outcome: Outcome, worst: bool) -> np.ndarray:
    """(H, W, 3) picture of a trial in the middle, or where the rings are farthest off."""
    run = load_run(out / 'trials' / outcome.trial.name)
    track, index = run.result.track, len(run.result.track) // 2
    if worst:
        found = errors(track, run.result.truth)
        stamp = found.stamps[np.argmax(found.translation_m[:, 1:].mean(axis=1))]
        index = int(np.flatnonzero(track.stamps == stamp)[0])
    return Painter(run, context_of(run)).picture(index)


def scene_picture(
    scene: Scene, prior: np.ndarray, fused: np.ndarray, clusters: Sequence[AnomalyCluster]
) -> np.ndarray:
    """
    (H, W, 3) picture of a scene, its prior map (P, 3), what was reconstructed (F, 3), and found.

    Above the scene as it is and the map; below the reconstruction, and over the map in red what
    was found to differ.
    """
    low, high = np.quantile(fused, [0.01, 0.99], axis=0)
    camera = replace(camera_on(low, high), section=float(np.quantile(fused[:, 1], CUT_AWAY)))
    inside = np.all((prior > low - 0.1) & (prior < high + 0.1), axis=1)
    prior, fused = (points[points[:, 1] > camera.section] for points in (prior[inside], fused))
    sure = [one for one in clusters if one.confidence >= AnomalySettings().min_confidence]
    red = [dots(one.points[one.points[:, 1] > camera.section], 1.5 * POINT, RED) for one in sure]
    thin = prior[:: 1 + len(prior) // MOST_POINTS]
    panels = [
        scene_shapes(scene),
        by_depth(prior, camera),
        by_depth(fused, camera),
        [dots(thin, POINT, GREY), *red],
    ]
    drawn = [np.pad(render(shapes, camera), ((0, GAP), (0, GAP), (0, 0))) for shapes in panels]
    return np.vstack([np.hstack(drawn[:2]), np.hstack(drawn[2:])])


def by_depth(points: np.ndarray, camera: Camera) -> list[Shape]:
    """Dots at points (P, 3), shaded by how far they are from the camera."""
    points = points[:: 1 + len(points) // MOST_POINTS]
    depth = np.linalg.norm(points - camera.eye, axis=1)
    order = np.array_split(np.argsort(depth), DEPTHS)
    shades = NEAR + np.linspace(0.0, 1.0, DEPTHS)[:, None] * (FAR - NEAR)
    return [
        dots(points[part], POINT, tuple(shade))
        for part, shade in zip(order, shades, strict=True)
        if len(part)
    ]


def html(image: np.ndarray) -> str:
    """Put a picture (H, W, 3) uint8 into a page that needs no other file."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, 'JPEG', quality=85)
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<img style="width: 100%" src="data:image/jpeg;base64,{data}">'
