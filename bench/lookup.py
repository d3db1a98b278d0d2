"""
Nearest-neighbour lookup in a map of 500,000 points, beside SciPy, Open3D, KISS-ICP and small_gicp.

`run(quick)` gives a list of rows, each ours against one peer on one workload; `scaling(quick)` the
cost of a lookup against the size of the map. The process is pinned to one core while it measures,
so that everybody has one thread.

Workloads, on the engine scene (thin blades):
- *filter*: frames of 16 sensors x 64 zones that drift by 3 mm a frame with 5 mm of noise, looked
  up three times with a slightly corrected pose, as the iterations of the filter do;
- *scattered*: single places all over the map, 1 to 10 cm from it;
- *facing the beam*: the filter's frames where its beams have been before; *new beams*: for an
  index that has seen none of them;
- *map*: what is made of a map before the first lookup.

KISS-ICP does not offer its lookup alone: its row is one iteration of its registration, which adds
the 6x6 sums of each pair. Its voxel map looks no further than the 27 voxels around, so that it is
exact only near the surface.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import time

from bench.harness import one_core, paired, side_by_side
from continuum_loc.mapping.build import sample_mesh
from continuum_loc.mapping.facing import PATIENCE
from continuum_loc.mapping.prior_map import PriorMap
import numpy as np

BOUNDS = [
    (f'lookup, {workload}', 'ratio', 'at least', 3.0)
    for workload in ('filter', 'scattered', 'facing')
]
MAX_DISTANCE, MIN_COS = 0.1, 0.1
NEIGHBOURS = 16  # that a peer is asked for where the nearest may not face the beam
MAP_POINTS = 500_000
Query = Callable[[np.ndarray], object]


def run(quick: bool = False) -> list[dict]:
    """
    Rows of name, ours_s, peer, peer_s, ratio (peer / ours) and spread (its quartiles).

    Times are seconds per lookup.
    """
    prior = _engine_map(MAP_POINTS // (10 if quick else 1))
    repeats = 5 if quick else 15
    index = prior.index(reach=MAX_DISTANCE).prepare()
    frames, scattered = _filter_frames(prior, 5 if quick else 20), [_scattered(prior)]
    peers = dict(_peers(prior))
    with one_core():
        rows = [
            _compare(name, lambda q: index.nearest(q, MAX_DISTANCE), peer, query, batches, repeats)
            for name, batches in (('lookup, filter', frames), ('lookup, scattered', scattered))
            for peer, query in peers.items()
        ]
        fastest = min(
            (row for row in rows if row['name'] == 'lookup, filter'), key=lambda row: row['peer_s']
        )['peer']
        rows += _compare_facing(prior, index, fastest, peers[fastest], frames, repeats)
        rows += _compare_made(prior, repeats // 5)
    return rows


def scaling(quick: bool = False) -> list[dict]:
    """
    Rows of points, build_s, lookup_s, index_bytes, lists and groups (in a list, on average).

    Times are seconds, of a lookup in filter frames.
    """
    rows = []
    for count in (5_000, 50_000, 500_000) if quick else (5_000, 50_000, 500_000, 5_000_000):
        prior = _random_map(count)
        frames = _filter_frames(prior, 10)
        started = time.perf_counter()
        index = prior.index(reach=MAX_DISTANCE).prepare()
        built = time.perf_counter() - started
        with one_core():
            lookup = min(
                _ask(lambda q, index=index: index.nearest(q, MAX_DISTANCE), frames)
                for _ in range(5)
            )
        size = sum(
            array.nbytes for array in (*index.arrays, *index.near) if isinstance(array, np.ndarray)
        )
        lists = np.count_nonzero(np.diff(index.near.begins))
        rows.append(
            {
                'points': count,
                'build_s': built,
                'lookup_s': lookup,
                'index_bytes': size,
                'lists': lists,
                'groups': len(index.near.groups) / lists,
            }
        )
    return rows


def _engine_mesh() -> tuple[np.ndarray, np.ndarray]:
    from continuum_loc.simulator.scenes import load_scene

    scene = load_scene('S0')
    return scene.vertices, scene.faces


def _engine_map(count: int) -> PriorMap:
    return sample_mesh(*_engine_mesh(), count=count, seed=0)


def _random_map(count: int) -> PriorMap:
    """
    As many random points on the engine.

    Much faster to make than blue noise, and the index does not care.
    """
    import trimesh

    mesh = trimesh.Trimesh(*_engine_mesh(), process=False)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    return PriorMap(
        points, mesh.face_normals[faces], np.ones(count), spacing=float(np.sqrt(mesh.area / count))
    )


def _filter_frames(prior: PriorMap, frames: int, iterations: int = 3) -> list[np.ndarray]:
    """`frames * iterations` batches (1024, 3) of zones of 16 sensors."""
    zones, rng = _filter_zones(prior)
    drift = np.repeat(0.003 * _unit(rng.normal(size=(16, 3))), 64, axis=0)
    batches = []
    for frame in range(frames):
        measured = zones + frame * drift + rng.normal(0.0, 0.005, zones.shape)
        for iteration in range(iterations):
            pose_error = np.repeat(rng.normal(0.0, 0.01 / 4**iteration, (16, 3)), 64, axis=0)
            batches.append(measured + pose_error)
    return batches


def _filter_zones(prior: PriorMap) -> tuple[np.ndarray, np.random.Generator]:
    """
    (1024, 3) places where the zones of 16 sensors hit the map at first.

    Each sensor sees a patch of 0.25 m radius.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    tree = cKDTree(prior.points)
    anchors = rng.integers(0, len(prior), 16)
    seen = [rng.choice(tree.query_ball_point(prior.points[a], 0.25), 64) for a in anchors]
    return prior.points[np.concatenate(seen)], rng


def _scattered(prior: PriorMap, count: int = 20_000) -> np.ndarray:
    rng = np.random.default_rng(1)
    rows = rng.integers(0, len(prior), count)
    return prior.points[rows] + rng.uniform(0.01, 0.1, (count, 1)) * _unit(
        rng.normal(size=(count, 3))
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _peers(prior: PriorMap) -> Iterator[tuple[str, Query]]:
    """Every peer that is installed, by name, as a function of a batch of queries."""
    from scipy.spatial import cKDTree

    tree = cKDTree(prior.points)
    yield 'SciPy cKDTree', lambda q: tree.query(q, distance_upper_bound=MAX_DISTANCE, workers=1)
    for optional in (_open3d_peers, _small_gicp_peer, _kiss_icp_peer):
        try:
            yield from optional(prior)
        except ImportError:
            continue


def _open3d_peers(prior: PriorMap) -> Iterator[tuple[str, Query]]:
    import open3d

    search = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(prior.points))
    search.knn_index()
    yield 'Open3D NearestNeighborSearch', lambda q: search.knn_search(open3d.core.Tensor(q), 1)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(prior.points))
    tree = open3d.geometry.KDTreeFlann(cloud)
    yield 'Open3D KDTreeFlann', lambda q: [tree.search_knn_vector_3d(place, 1) for place in q]


def _small_gicp_peer(prior: PriorMap) -> Iterator[tuple[str, Query]]:
    import small_gicp

    tree = small_gicp.KdTree(prior.points)
    yield 'small_gicp KdTree', lambda q: tree.batch_knn_search(q, 1, num_threads=1)


def _kiss_icp_peer(prior: PriorMap, voxel: float = 0.03) -> Iterator[tuple[str, Query]]:
    from kiss_icp.pybind import kiss_icp_pybind

    voxel_map = kiss_icp_pybind._VoxelHashMap(voxel, 1e3, 400)
    voxel_map._add_points(kiss_icp_pybind._Vector3dVector(prior.points))
    registration = kiss_icp_pybind._Registration(1, 1e-12, 1)

    def query(q: np.ndarray) -> np.ndarray:
        points = kiss_icp_pybind._Vector3dVector(q)
        return registration._align_points_to_map(points, voxel_map, np.eye(4), MAX_DISTANCE, 0.01)

    yield 'KISS-ICP registration step', query


def _ask(query: Query, batches: list[np.ndarray]) -> float:
    """
    Seconds of processor time per lookup.

    On one core that is what one waits for, without what others do to it.
    """
    started = time.process_time()
    for batch in batches:
        query(batch)
    return (time.process_time() - started) / sum(map(len, batches))


def _compare(
    name: str, ours: Query, peer: str, query: Query, batches: list[np.ndarray], repeats: int
) -> dict:
    return side_by_side(
        name,
        lambda: [ours(batch) for batch in batches],
        peer,
        lambda: [query(batch) for batch in batches],
        repeats,
        per_call=sum(map(len, batches)),
    )


def _compare_made(prior: PriorMap, repeats: int) -> Iterator[dict]:
    """Compare what making an index takes, and what making the lists of `nearest` adds."""
    from scipy.spatial import cKDTree

    for name, ours in (
        ('map, for beams', lambda: prior.index(reach=MAX_DISTANCE)),
        ('map, for any point', lambda: prior.index(reach=MAX_DISTANCE).prepare()),
    ):
        yield side_by_side(
            f'lookup, {name}', ours, 'SciPy cKDTree', lambda: cKDTree(prior.points), repeats
        )


def _compare_facing(prior, index, peer, query, batches, repeats) -> list[dict]:
    """
    Compare the nearest surface that faces the beam, which no peer can be asked for.

    Once beside the nearest point of all, which is less work, and once beside what a user would do:
    ask for NEIGHBOURS at once and take the first that faces, where there is one.
    """
    rng = np.random.default_rng(2)
    rows, _ = index.nearest(_filter_zones(prior)[0], MAX_DISTANCE)
    beams = _unit(-prior.normals[rows] + 0.3 * rng.normal(size=(len(rows), 3)))
    ours: Query = lambda q: index.nearest_facing(q, beams, MAX_DISTANCE, MIN_COS)  # noqa: E731
    any_point = f'{peer}, any point'
    new = _compare_new_beams(index, beams, any_point, query, batches, repeats)
    for _ in range(PATIENCE):
        _ask(ours, batches)
    name, (other, first_of) = (
        'lookup, facing the beam',
        _first_that_faces(prior, beams, ours, batches),
    )
    return [
        _compare(name, ours, any_point, query, batches, repeats),
        _compare(name, ours, other, first_of, batches, repeats),
        new,
    ]


def _compare_new_beams(index, beams, peer, query, batches, repeats) -> dict:
    """Every repeat begins with an empty cache, as a filter does that has just been started."""
    pairs = []
    for _ in range(repeats):
        fresh = index.copy()
        ours = _ask(
            lambda q, fresh=fresh: fresh.nearest_facing(q, beams, MAX_DISTANCE, MIN_COS), batches
        )
        pairs.append((ours, _ask(query, batches)))
    return paired('lookup, new beams', peer, np.array(pairs))


def _first_that_faces(prior: PriorMap, beams: np.ndarray, ours: Query, batches: list[np.ndarray]):
    """Ask a tree for several neighbours: its name and share of our answers, and the query."""
    from scipy.spatial import cKDTree

    tree = cKDTree(prior.points)

    def query(q: np.ndarray) -> np.ndarray:
        _, rows = tree.query(q, NEIGHBOURS, workers=1)
        faces = -np.einsum('qi,qki->qk', beams, prior.normals[rows]) >= MIN_COS
        return np.where(faces.any(axis=1), rows[np.arange(len(q)), faces.argmax(axis=1)], -1)

    share = np.mean([np.mean(query(batch) == ours(batch)[0]) for batch in batches[:3]])
    return f'SciPy cKDTree, first of {NEIGHBOURS} (finds {share:.0%})', query


if __name__ == '__main__':
    for row in run():
        print(
            f'{row["name"]:24s} {row["ours_s"] * 1e9:7.0f} ns   {row["peer"]:28s} '
            f'{row["peer_s"] * 1e9:8.0f} ns   {row["ratio"]:6.1f} x  ({row["spread"][0]:.1f} to '
            f'{row["spread"][1]:.1f})'
        )
    for row in scaling():
        print(
            f'{row["points"]:9d} points: built in {row["build_s"]:.2f} s, '
            f'{row["index_bytes"] / 1e6:.0f} MB, '
            f'{row["lists"]} lists of {row["groups"]:.1f} groups, '
            f'lookup {row["lookup_s"] * 1e9:.0f} ns'
        )
