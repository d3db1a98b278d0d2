"""
What the filter asks of the map's index, beside what one would ask a tree instead.

`run(quick)` gives rows of what the filter calls (`nearest_facing_batch`): the nearest map point
to the end of a beam among those that face it. It is asked for the places where the filter asks:
every zone that the engine robot in S0 measures along t2, at the estimated poses, some thousand
(an instant's 16 sensors of 64 zones) at a time, in the map of that trial. The process is pinned
to one core while it measures, so that everybody has one thread.

- *facing the beam*: no peer offers it. Theirs is what one would do with a tree: take NEIGHBOURS
  and of them the first that faces the beam; the row says how often that is the right one.
- *facing, their any point*: beside a peer's plain nearest point, which is an easier question.
- *index of the map*: what is made once for all users of a map in a process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from bench.harness import one_core, side_by_side
from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
from continuum_loc.measurements import TofFrame
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.replay import replay
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import measured, Trial
from continuum_loc.robot import load_robot
from continuum_loc.scene.anomalies import Beams
from continuum_loc.scene.reconstruct import reconstruct
import numpy as np

BOUNDS = [('lookup, facing the beam', 'ratio', 'at least', 3.0)]
NEIGHBOURS = 16  # that a peer is asked for where the nearest may not face the beam
BATCH = 1024  # beams at a time
Neighbours = Callable[[np.ndarray, int], np.ndarray]
Batch = tuple[np.ndarray, np.ndarray]  # ends (Q, 3) and directions (Q, 3) of beams


def run(quick: bool = False) -> list[dict]:
    """
    Rows of name, ours_s, peer, peer_s, ratio (peer / ours) and spread (its quartiles).

    Times are seconds per lookup, or to make an index.
    """
    prior, repeats = scene_map('S0'), 5 if quick else 15
    batches = _asked(prior, 1.0 if quick else 8.0)
    tof = load_estimator_settings('engine').tof

    def ours(batch: Batch) -> np.ndarray:
        return prior.index.nearest_facing(*batch, tof.gate, tof.min_cosine)[0]

    with one_core():
        peers = list(_peers(prior))
        return [
            *(_facing(prior, ours, *peer, batches, repeats) for peer in peers),
            *(_any_point(ours, *peer, batches, repeats) for peer in peers),
            _made(prior, repeats),
        ]


def _asked(prior: PriorMap, duration: float) -> list[Batch]:
    """List the beams of a run of the filter in the order of their frames."""
    robot = load_robot('engine')
    samples = measured(Trial('engine', 'S0', 't2', duration=duration))
    track = replay(samples, make_filter(robot, prior)).track
    frames = [sample for sample in samples if isinstance(sample, TofFrame)]
    placed = reconstruct(robot, frames, track)
    count = len(placed.points)
    directions = Beams.of(placed).directions[:count]
    return [
        (placed.points[first:][:BATCH], directions[first:][:BATCH])
        for first in range(0, len(directions), BATCH)
    ]


def _peers(prior: PriorMap) -> Iterator[tuple[str, Neighbours]]:
    """Every peer that is installed, by name, as a function to rows (Q, k) of the k nearest."""
    from scipy.spatial import cKDTree

    tree = cKDTree(prior.points)
    yield 'SciPy cKDTree', lambda q, k: tree.query(q, np.arange(1, k + 1), workers=1)[1]
    for optional in (_open3d_peer, _small_gicp_peer):
        try:
            yield optional(prior)
        except ImportError:
            continue


def _open3d_peer(prior: PriorMap) -> tuple[str, Neighbours]:
    import open3d

    search = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(prior.points))
    search.knn_index()
    return (
        'Open3D NearestNeighborSearch',
        lambda q, k: search.knn_search(open3d.core.Tensor(q), k)[0].numpy(),
    )


def _small_gicp_peer(prior: PriorMap) -> tuple[str, Neighbours]:
    import small_gicp

    tree = small_gicp.KdTree(prior.points)
    return (
        'small_gicp KdTree',
        lambda q, k: np.asarray(tree.batch_knn_search(q, k, num_threads=1)[0]),
    )


def _facing(prior, ours, peer, neighbours, batches, repeats) -> dict:
    tof = load_estimator_settings('engine').tof

    def first_that_faces(batch: Batch) -> np.ndarray:
        ends, directions = batch
        rows = neighbours(ends, NEIGHBOURS)
        cosine = -np.einsum('qi,qki->qk', directions, prior.normals[rows])
        faces = cosine >= tof.min_cosine
        found = rows[np.arange(len(rows)), faces.argmax(axis=1)]
        near = np.sum((prior.points[found] - ends) ** 2, axis=1) < tof.gate**2
        return np.where(faces.any(axis=1) & near, found, -1)

    right = np.concatenate([first_that_faces(batch) == ours(batch) for batch in batches])
    return _compare(
        'lookup, facing the beam',
        ours,
        f'{peer}, first of {NEIGHBOURS} (right for {np.mean(right):.1%})',
        first_that_faces,
        batches,
        repeats,
    )


def _any_point(ours, peer, neighbours, batches, repeats) -> dict:
    return _compare(
        'lookup, facing, their any point',
        ours,
        f'{peer}, any point',
        lambda batch: neighbours(batch[0], 1),
        batches,
        repeats,
    )


def _compare(
    name: str, ours: Callable, peer: str, theirs: Callable, batches: list[Batch], repeats: int
) -> dict:
    return side_by_side(
        name,
        lambda: [ours(batch) for batch in batches],
        peer,
        lambda: [theirs(batch) for batch in batches],
        repeats,
        per_call=sum(len(ends) for ends, _ in batches),
    )


def _made(prior: PriorMap, repeats: int) -> dict:
    from scipy.spatial import cKDTree

    return side_by_side(
        'lookup, index of the map',
        lambda: VoxelIndex(prior.points, prior.normals),
        'SciPy cKDTree',
        lambda: cKDTree(prior.points),
        repeats,
        memory_bytes=prior.index.memory_bytes,
    )


if __name__ == '__main__':
    for row in run():
        print(row)
