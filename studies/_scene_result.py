"""What the trials of one scene gave, for the study of anomalies and its report."""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc.scene.anomalies import AnomalyCluster, Truth
import numpy as np


@dataclass(frozen=True, eq=False)
class SceneResult:
    """
    What the trials of one scene gave.

    rmse_m: of the fused surfels, of the measured points, and of points placed by the true poses
    (the sensors' share) to the true mesh. covered: share of the surfels whose distance to it is
    within 3 standard deviations. truth: the known anomalies that were seen, of `known`. fused:
    what the view to turn shows. picture: (H, W, 3) of `scene_picture`.
    """

    scene: str
    points: int
    surfels: int
    rmse_m: dict[str, float]
    covered: float
    clusters: list[AnomalyCluster]
    truth: list[Truth]
    known: int
    fused: np.ndarray
    picture: np.ndarray
