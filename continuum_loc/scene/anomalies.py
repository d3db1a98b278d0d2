"""
New and missing things: where measurements differ from the prior map (paper, VI-C.4, eq. 12).

A *new* point is one whose squared Mahalanobis distance to the nearest map point exceeds tau. A map
point stands for
the surface around it, so Sigma_nn is flat: the map's sigma along the normal, and across it the
scatter of the samples themselves. A blue-noise cell of mean area A has a mean square radius A / (2
pi), half of that along each tangent.

A *missing* surface is one that a beam went through: the map, taken as discs, is crossed clearly
before the measured end. Either kind also has its witnesses to the contrary (points that fit the
map; beams that end on it), so that the
evidence at a place is a share: how many of the beams that could tell disagree with the map. Places
where most of them do are joined to clusters; the confidence of a cluster is the lower bound of
that share (Wilson's), which grows with the number of beams and falls with every one that agrees.

Points do not say where between two of them a surface ends. Beams that graze an edge of the map
therefore disagree with it where nothing has changed, and always at the same places. So a cluster
counts only where enough of its beams differ from everything that the map shows round their line,
as far as its spacing goes: what an edge a little elsewhere would explain is no anomaly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args, Literal, NamedTuple

from continuum_loc.errors import MapError
from continuum_loc.mapping.build import DENSITY
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
from continuum_loc.scene.free_space import passes
from continuum_loc.scene.reconstruct import distances_to_mesh, Reconstruction
from continuum_loc.scene.splat_cast import first_crossings
from continuum_loc.settings import Settings
import numpy as np
from pydantic import Field

Kind = Literal['added', 'missing']
CLEARLY = 0.02  # m: more than a range errs by
PARALLELS = 6  # lines round a beam along which the map is looked at


class AnomalySettings(Settings):
    """Thresholds of the detector."""

    tau: float = Field(
        9.0,
        gt=0.0,
        description='squared Mahalanobis distance of a new point: 3 standard deviations',
    )
    min_distance: float = Field(
        0.01, ge=0.0, description='nothing closer to the map than this is new or missing [m]'
    )
    clear: float = Field(
        2.0,
        ge=0.0,
        description='standard deviations short of its end up to which a beam has seen through',
    )
    stray_share: float = Field(
        0.35,
        ge=0.0,
        description='share of the beams through a cell below which new points in it are stray',
    )
    search_radius: float = Field(
        0.3, gt=0.0, description='a point with no map within this is new outright [m]'
    )
    cell: float = Field(
        0.015, gt=0.0, description='edge of the cells in which evidence is gathered [m]'
    )
    min_share: float = Field(
        0.5, gt=0.0, le=1.0, description='share of disagreeing beams that makes a cell suspect'
    )
    min_beams: int = Field(10, ge=1, description='disagreeing beams that a cluster needs')
    min_size: float = Field(
        0.025,
        ge=0.0,
        description='extent that a cluster of few beams needs [m]: map edges fray by less',
    )
    many_beams: int = Field(
        50,
        ge=1,
        description='disagreeing beams from which extent does not matter: that of missing things '
        'is known to the spacing of the map alone',
    )
    disc: float = Field(
        0.6,
        gt=0.0,
        description="radius of the map's discs, in spacings; larger ones overhang edges",
    )
    min_frames: int = Field(2, ge=1, description='different instants that they must come from')
    link: float = Field(
        0.03, gt=0.0, description='cells closer than this belong to one cluster [m]'
    )
    added_width: float = Field(
        0.5, ge=0.0, description='how far off its line a beam to new things looks, in spacings'
    )
    missing_width: float = Field(
        1.0,
        ge=0.0,
        description='the same for missing things: discs overhang the edges of the map by as much',
    )
    min_unexplained: float = Field(
        0.2,
        ge=0.0,
        le=1.0,
        description="share of a cluster's beams that no edge nearby may explain",
    )
    min_confidence: float = Field(
        0.33, ge=0.0, le=1.0, description='confidence from which a cluster is worth a look'
    )
    confidence_z: float = Field(
        1.64, gt=0.0, description="standard deviations of the confidence's lower bound"
    )


@dataclass(frozen=True, eq=False)
class AnomalyCluster:
    """
    One difference: `added` to the scene or `missing` from it.

    points: (K, 3) [m] measured points (added) or map points passed through (missing); centre: (3,)
    their mean;
    extent: (3,) edges of their bounding box [m]; beams: how many disagree; frames: from how many
    instants;
    confidence: lower bound of the share of beams there that disagree with the map, 0..1.
    """

    kind: Kind
    points: np.ndarray
    centre: np.ndarray
    extent: np.ndarray
    beams: int
    frames: int
    confidence: float
    witnesses: np.ndarray

    @property
    def size(self) -> float:
        """Longest edge of the bounding box [m]."""
        return float(self.extent.max())


class Evidence(NamedTuple):
    """
    What the measurements say of some places, for or against the map.

    Places (N, 3) [m], whether the beam there disagrees with the map (N,), its stamp (N,) ns, and
    its row in `Beams` (N,).
    """

    places: np.ndarray
    disagrees: np.ndarray
    stamps: np.ndarray
    rows: np.ndarray


class Beams(NamedTuple):
    """
    All beams of a reconstruction, those that met nothing last.

    origins: (B, 3) [m]; directions: (B, 3) unit; lengths: (B,) [m]; sigma: (B,) [m] standard
    deviation along the beam, 0 without a return; stamps: (B,).
    """

    origins: np.ndarray
    directions: np.ndarray
    lengths: np.ndarray
    sigma: np.ndarray
    stamps: np.ndarray

    @classmethod
    def of(cls, reconstruction: Reconstruction) -> Beams:
        """Take the beams to every point, and those without a return as far as sensors reach."""
        r = reconstruction
        origins = np.concatenate([r.origins, r.open_origins])
        along = np.concatenate([r.points, r.open_ends]) - origins
        length = np.linalg.norm(along, axis=1)
        directions = along / np.maximum(length, 1e-12)[:, None]
        hit = directions[: len(r.points)]
        sigma = np.zeros(len(along))
        sigma[: len(hit)] = np.sqrt(np.einsum('ni,nij,nj->n', hit, r.covariance, hit))
        # Each open beam counts as an instant of its own: they come from all over the run.
        stamps = np.concatenate([r.stamps, np.arange(len(r.open_origins))])
        return cls(origins, directions, length, sigma, stamps)

    def margin(self, prior: PriorMap, settings: AnomalySettings) -> np.ndarray:
        """(B,) [m] by which a beam's end must be off the map to disagree with it."""
        return np.maximum(
            np.sqrt(settings.tau * (self.sigma**2 + prior.sigma**2)), settings.min_distance
        )

    def of_rows(self, rows: np.ndarray) -> Beams:
        """Take some of them."""
        return Beams(*(values[rows] for values in self))


def detect_anomalies(
    reconstruction: Reconstruction,
    prior: PriorMap,
    settings: AnomalySettings | None = None,
    index: VoxelIndex | None = None,
) -> list[AnomalyCluster]:
    """
    All differences of both kinds, most confident first.

    `index`: of `prior`, if there is one already.
    """
    settings = settings or AnomalySettings()
    index = index or prior.index
    beams = Beams.of(reconstruction)
    missing = clusters(missing_evidence(beams, prior, settings, index), 'missing', settings)
    behind = behind_map(beams, prior, index, len(reconstruction.points))
    new = new_evidence(reconstruction, prior, settings, index, behind)
    added = clusters(new, 'added', settings, beams)
    found = [
        cluster
        for cluster in added + missing
        if unexplained_share(cluster, beams, prior, settings, index) >= settings.min_unexplained
    ]
    return sorted(found, key=lambda cluster: -cluster.confidence)


def unexplained_share(
    cluster: AnomalyCluster,
    beams: Beams,
    prior: PriorMap,
    settings: AnomalySettings,
    index: VoxelIndex,
) -> float:
    """
    Share of a cluster's witnesses that differ from all that the map shows round their line.

    To new things: they end before the nearest of it. Of missing ones: they end behind the
    farthest, and there is some all round.
    """
    own = beams.of_rows(cluster.witnesses)
    added, margin = cluster.kind == 'added', own.margin(prior, settings)
    width = prior.spacing * (settings.added_width if added else settings.missing_width)
    nearest, farthest = depths_around(prior, index, own, own.lengths + margin, width)
    differs = own.lengths < nearest - margin if added else own.lengths > farthest + margin
    return float(np.mean(differs))


def depths_around(
    prior: PriorMap, index: VoxelIndex, beams: Beams, reach: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray]:
    """
    (B,) nearest and (B,) farthest depth [m] at which the map is crossed on and round each beam.

    Round it: by parallels at `width` [m]. reach: (B,) [m] how far to look; inf where nothing is
    crossed.
    """
    helper = np.eye(3)[np.argmin(np.abs(beams.directions), axis=1)]
    across = np.cross(beams.directions, helper)
    across *= width / np.linalg.norm(across, axis=1, keepdims=True)
    upward = np.cross(beams.directions, across)
    turns = np.linspace(0.0, 2.0 * np.pi, PARALLELS, endpoint=False)
    aside = [np.cos(turn) * across + np.sin(turn) * upward for turn in turns]
    depths = np.stack(
        [
            first_crossings(prior, index, beams.origins + offset, beams.directions, reach)[1]
            for offset in (np.zeros(3), *aside)
        ]
    )
    return depths.min(axis=0), depths.max(axis=0)


def new_evidence(
    reconstruction: Reconstruction,
    prior: PriorMap,
    settings: AnomalySettings,
    index: VoxelIndex,
    behind: np.ndarray | None = None,
) -> Evidence:
    """
    Judge every measured point by whether it lies off the map (eq. 12), and before it.

    What lies `behind` the map (N,), on the beam, is no new thing: the range erred, or something
    missing has laid it open.
    """
    distance2, offset = mahalanobis2(reconstruction, prior, settings.search_radius, index)
    disagrees = (distance2 > settings.tau) & (offset > settings.min_distance)
    if behind is not None:
        disagrees &= ~behind
    return Evidence(
        reconstruction.points, disagrees, reconstruction.stamps, np.arange(len(disagrees))
    )


def mahalanobis2(
    reconstruction: Reconstruction, prior: PriorMap, search_radius: float, index: VoxelIndex
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) left side of eq. 12 and (N,) distance [m] to the nearest map point; inf where none."""
    row, distance = index.nearest(reconstruction.points, search_radius)
    distance2 = np.full(len(row), np.inf)
    found = np.flatnonzero(row >= 0)
    normal = prior.normals[row[found]]
    offset = reconstruction.points[found] - prior.points[row[found]]
    tangential = tangential_variance(prior)
    covariance = reconstruction.covariance[found] + (prior.sigma**2 + tangential) * np.eye(3)
    covariance -= tangential * normal[:, :, None] * normal[:, None, :]
    distance2[found] = np.einsum(
        'ni,ni->n', offset, np.linalg.solve(covariance, offset[:, :, None])[:, :, 0]
    )
    return distance2, distance


def tangential_variance(prior: PriorMap) -> float:
    """Variance [m^2], along each tangent, of a surface point about the nearest of its samples."""
    return prior.spacing**2 / DENSITY / (4.0 * np.pi)


def missing_evidence(
    beams: Beams, prior: PriorMap, settings: AnomalySettings, index: VoxelIndex
) -> Evidence:
    """
    Judge every mapped surface that a beam should have met first: did the beam go through it.

    A beam that ends in front of the mapped surface says nothing about it. One without a return
    went its whole length.
    """
    margin = beams.margin(prior, settings)
    row, depth = first_crossings(
        prior,
        index,
        beams.origins,
        beams.directions,
        beams.lengths + margin,
        radius=settings.disc * prior.spacing,
    )
    met, through = np.flatnonzero(row >= 0), beams.lengths - depth > margin
    return Evidence(prior.points[row[met]], through[met], beams.stamps[met], met)


def behind_map(beams: Beams, prior: PriorMap, index: VoxelIndex, count: int) -> np.ndarray:
    """
    Whether the map lies before the end of each of the first `count` beams.

    The map's discs are taken so large that they leave no gaps.
    """
    first = slice(None, count)
    row, depth = first_crossings(
        prior, index, beams.origins[first], beams.directions[first], beams.lengths[first]
    )
    return (row >= 0) & (depth < beams.lengths[first])


def clusters(
    evidence: Evidence, kind: Kind, settings: AnomalySettings, beams: Beams | None = None
) -> list[AnomalyCluster]:
    """
    Join the cells in which most beams disagree with the map.

    beams: of which those that run clear through a cell speak against anything new in it.
    """
    if not evidence.disagrees.any():
        return []
    cells, cell_of = np.unique(
        np.floor(evidence.places / settings.cell).astype(np.int64), axis=0, return_inverse=True
    )
    cell_of = cell_of.ravel()
    total = np.bincount(cell_of, minlength=len(cells))
    against = np.bincount(cell_of, weights=evidence.disagrees, minlength=len(cells))
    suspect = (against > 0) & (against >= settings.min_share * total)
    if beams is not None:
        seen_through = passes(
            cells[suspect],
            settings.cell,
            beams.origins,
            beams.directions,
            beams.lengths - np.maximum(settings.clear * beams.sigma, settings.min_distance),
        )
        suspect[suspect] = against[suspect] >= settings.stray_share * seen_through
    label = np.full(len(cells), -1)
    label[suspect] = _linked((cells[suspect] + 0.5) * settings.cell, settings.link)
    found = (
        _cluster(evidence, np.flatnonzero(label[cell_of] == number), kind, settings)
        for number in range(label.max() + 1)
    )
    return [cluster for cluster in found if cluster is not None]


def _linked(centres: np.ndarray, link: float) -> np.ndarray:
    """(N,) number of the connected component of each place; nearer than `link` is joined."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(centres).query_pairs(link, output_type='ndarray')
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centres),) * 2)
    return connected_components(graph, directed=False)[1]


def _cluster(
    evidence: Evidence, members: np.ndarray, kind: Kind, settings: AnomalySettings
) -> AnomalyCluster | None:
    against = members[evidence.disagrees[members]]
    frames = len(np.unique(evidence.stamps[against]))
    if len(against) < settings.min_beams or frames < settings.min_frames:
        return None
    points = evidence.places[against]
    small = np.ptp(points, axis=0).max() < settings.min_size
    if small and len(against) < settings.many_beams:
        return None
    return AnomalyCluster(
        kind,
        points,
        points.mean(axis=0),
        np.ptp(points, axis=0),
        len(against),
        frames,
        wilson_lower_bound(len(against), len(members), settings.confidence_z),
        evidence.rows[against],
    )


def wilson_lower_bound(successes: int, trials: int, z: float) -> float:
    """Lower bound of a proportion (Wilson, 1927), `z` standard deviations below."""
    share = successes / trials
    spread = z * np.sqrt(share * (1.0 - share) / trials + z**2 / (4.0 * trials**2))
    return float((share + z**2 / (2.0 * trials) - spread) / (1.0 + z**2 / trials))


class Truth(NamedTuple):
    """A known anomaly: kind and closed mesh (V, 3), (F, 3) of what was added or taken away."""

    kind: Kind
    vertices: np.ndarray
    faces: np.ndarray

    @property
    def size(self) -> float:
        """Longest edge of the bounding box [m]."""
        return float(np.ptp(self.vertices, axis=0).max())


@dataclass(frozen=True)
class PrecisionRecall:
    """
    One row per confidence threshold.

    Clusters kept, how many of them are real, real anomalies found, and both as shares (precision
    is 1 where nothing is kept, recall 1 where there was nothing to find).
    """

    threshold: np.ndarray
    kept: np.ndarray
    correct: np.ndarray
    found: np.ndarray
    truths: int

    @property
    def precision(self) -> np.ndarray:
        return np.where(self.kept > 0, self.correct / np.maximum(self.kept, 1), 1.0)

    @property
    def recall(self) -> np.ndarray:
        return self.found / self.truths if self.truths else np.ones(len(self.threshold))


def precision_recall(
    detected: Sequence[AnomalyCluster],
    truth: Sequence[Truth],
    thresholds: np.ndarray,
    margin: float = 0.02,
) -> PrecisionRecall:
    """
    Precision and recall of the clusters with at least each confidence threshold.

    A cluster is right when it is of the same kind as a true anomaly and most of its points lie
    within `margin` [m] of that one's surface. A true anomaly is found by one such cluster; several
    clusters on it are all right.
    """
    thresholds = np.asarray(thresholds, dtype=np.float64)
    match = np.array(
        [[_matches(cluster, one, margin) for one in truth] for cluster in detected], bool
    )
    match = match.reshape(len(detected), len(truth))
    kept = np.array([cluster.confidence for cluster in detected])[None, :] >= thresholds[:, None]
    return PrecisionRecall(
        threshold=thresholds,
        kept=kept.sum(axis=1),
        correct=(kept & match.any(axis=1)).sum(axis=1),
        found=(kept[:, :, None] & match[None]).any(axis=1).sum(axis=1),
        truths=len(truth),
    )


def _matches(cluster: AnomalyCluster, truth: Truth, margin: float) -> bool:
    if cluster.kind != truth.kind:
        return False
    return bool(np.mean(_near_solid(cluster.points, truth, margin)) > 0.5)


def _near_solid(points: np.ndarray, truth: Truth, margin: float) -> np.ndarray:
    lower, upper = truth.vertices.min(axis=0) - margin, truth.vertices.max(axis=0) + margin
    near = ((points >= lower) & (points <= upper)).all(axis=1)
    near[near] = distances_to_mesh(points[near], truth.vertices, truth.faces) < margin
    return near


def seen(
    truth: Sequence[Truth], reconstruction: Reconstruction, least_beams: int = 10
) -> list[Truth]:
    """
    Those of the true anomalies that enough beams met.

    Met: ended on (added) or went through (missing).

    Needs a reconstruction from the true poses: it says what could have been detected.
    """
    return [one for one in truth if beams_on(one, reconstruction) >= least_beams]


def beams_on(truth: Truth, reconstruction: Reconstruction) -> int:
    """
    Count the beams that met a true anomaly.

    Only those whose line meets its surface: beams that end on the wall close beside a thing do
    not show it.
    """
    if truth.kind not in get_args(Kind):
        raise MapError(f"an anomaly is added or missing, not '{truth.kind}'")
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(np.asarray(truth.vertices, np.float32), np.asarray(truth.faces, np.uint32))
    along = reconstruction.points - reconstruction.origins
    length = np.linalg.norm(along, axis=1)
    rays = np.concatenate([reconstruction.origins, along / length[:, None]], axis=1)
    depth = scene.cast_rays(rays.astype(np.float32), nthreads=1)['t_hit'].numpy()
    # What is beyond a range's error: it stopped at something else before, or went on behind.
    reached = length > depth + (CLEARLY if truth.kind == 'missing' else -CLEARLY)
    return int(np.count_nonzero(np.isfinite(depth) & reached))
