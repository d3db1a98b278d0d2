"""Scenes: closed, of the stated size, with free way and exact truth of their anomalies."""

from continuum_loc.caches import cache_folder
from continuum_loc.errors import SceneError
from continuum_loc.robot import load_robot
from continuum_loc.simulator import convex, cutting, mesh_import, scene_cache
from continuum_loc.simulator.mesh_import import check_mesh
from continuum_loc.simulator.raycast import RayCaster
from continuum_loc.simulator.scene import Anomaly, Scene
from continuum_loc.simulator.scenes import load_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from studies._pieces import standing_out
import trimesh

VARIANTS = ('S2', 'S5', 'S9')  # one of each kind: added objects, missing features, both
GENERATOR = 'continuum_loc.simulator.box'
CUBE = trimesh.creation.box((1.0, 1.0, 1.0))


def corridor(step: float = 0.02) -> np.ndarray:
    """Points of the straight engine robot over its whole insertion."""
    robot = load_robot('engine')
    along = np.arange(0.0, robot.length + robot.base.insertion.range[1], step)
    return np.array(robot.base.xyz) + along[:, None] * robot.base.T_map_base[:3, 0]


def as_trimesh(scene) -> trimesh.Trimesh:
    return trimesh.Trimesh(scene.vertices, scene.faces, process=False)


def scene_of_mesh(vertices: np.ndarray, faces: np.ndarray) -> Scene:
    zeros = np.zeros(len(faces), dtype=np.int32)
    return Scene(
        'mesh',
        np.array(vertices),
        np.array(faces, dtype=np.int32),
        zeros,
        ('mesh',),
        zeros + 0.5,
        (),
    )


def points_inside(anomaly: Anomaly, count: int = 5000) -> np.ndarray:
    low, high = anomaly.vertices.min(axis=0), anomaly.vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (count, 3))
    return points[
        RayCaster(scene_of_mesh(anomaly.vertices, anomaly.faces)).clearance(points) < -1e-4
    ]


@pytest.mark.parametrize('name', ['S0', *VARIANTS, 'R0', 'R4'])
def test_scene_is_closed_and_within_the_face_limit(name):
    mesh = as_trimesh(load_scene(name))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert len(mesh.faces) <= 200_000
    assert mesh.volume > 0.0
    assert mesh.area_faces.min() > 1e-12


def test_engine_is_3_1_m_across_with_its_axis_along_x():
    extent = np.ptp(load_scene('S0').vertices, axis=0)
    np.testing.assert_allclose(extent[1:], 3.1, atol=1e-3)


def test_a_blade_row_looks_the_same_after_a_pitch_up_to_its_mistuning():
    """
    The symmetry that misleads an estimate without strain.

    The next blade is within a few millimetres.
    """
    scene = load_scene('S0')
    caster = RayCaster(scene)
    of_rotor = np.array([name.startswith('rotor1') for name in scene.objects])[scene.face_object]
    radius, azimuth = (
        g.ravel()
        for g in np.meshgrid(np.linspace(0.6, 1.4, 30), np.radians(np.linspace(0, 20, 60)))
    )

    def look_downstream(turn: float) -> tuple[np.ndarray, np.ndarray]:
        origins = np.stack(
            [
                np.full_like(radius, 0.8),
                radius * np.sin(azimuth + turn),
                radius * np.cos(azimuth + turn),
            ],
            axis=1,
        )
        distance, face, _ = caster.cast(origins, np.tile([1.0, 0.0, 0.0], (len(radius), 1)))
        return distance, (face >= 0) & of_rotor[face]

    (here, hit_here), (next_blade, hit_next) = (
        look_downstream(0.0),
        look_downstream(2.0 * np.pi / 16),
    )
    both = hit_here & hit_next
    assert both.mean() > 0.2
    assert 1e-4 < np.median(np.abs(here[both] - next_blade[both])) < 0.01


def test_robot_has_free_way_through_the_engine():
    robot = load_robot('engine')
    clearance = RayCaster(load_scene('S0')).clearance(corridor())
    assert clearance.min() > robot.radius + 0.03
    before_the_last_rows = corridor()[:, 0] < 1.45
    # Room to bend by a decimetre.
    assert clearance[before_the_last_rows].min() > robot.radius + 0.10


@pytest.mark.parametrize('name', VARIANTS)
def test_volume_is_conserved_between_a_variant_and_the_engine_as_built(name):
    scene = load_scene(name)
    solids = {
        kind: sum(
            trimesh.Trimesh(a.vertices, a.faces).volume for a in scene.anomalies if a.kind == kind
        )
        for kind in ('added', 'missing')
    }
    difference = as_trimesh(scene).volume - as_trimesh(load_scene('S0')).volume
    assert difference == pytest.approx(solids['added'] - solids['missing'], rel=0.02, abs=2e-7)


@pytest.mark.parametrize('name', VARIANTS)
def test_anomalies_are_matter_in_one_scene_and_free_space_in_the_other(name):
    scene, variant, built = (
        load_scene(name),
        RayCaster(load_scene(name)),
        RayCaster(load_scene('S0')),
    )
    for anomaly in scene.anomalies:
        inside = points_inside(anomaly)
        assert len(inside) > 100
        matter, free = (variant, built) if anomaly.kind == 'added' else (built, variant)
        assert np.mean(matter.clearance(inside) <= 1e-5) > 0.99, anomaly.name
        assert np.mean(free.clearance(inside) >= -1e-5) > 0.99, anomaly.name


@pytest.mark.parametrize('name', VARIANTS)
def test_anomalies_are_3_to_15_cm_long_and_seen_from_the_robots_way(name):
    scene = load_scene(name)
    for anomaly in scene.anomalies:
        assert 0.03 <= anomaly.size <= 0.15, anomaly.name
        caster = RayCaster(scene if anomaly.kind == 'added' else load_scene('S0'))
        targets = trimesh.sample.sample_surface(
            trimesh.Trimesh(anomaly.vertices, anomaly.faces), 50, seed=0
        )[0]
        eyes = corridor(0.1)
        rays = targets[:, None] - eyes
        distance = np.linalg.norm(rays, axis=-1)
        hit, _, _ = caster.cast(
            np.tile(eyes, (len(targets), 1)), (rays / distance[..., None]).reshape(-1, 3)
        )
        seen = (np.abs(hit.reshape(distance.shape) - distance) < 1e-3) & (distance < 1.5)
        assert seen.any(axis=1).mean() > 0.1, anomaly.name


def test_each_face_belongs_to_the_part_that_made_it():
    """Rays from the robot's way onto an added object land on faces of that name."""
    scene = load_scene('S2')
    caster = RayCaster(scene)
    wrench = next(a for a in scene.anomalies if a.name == 'wrench')
    eye = wrench.centre + [0.0, 0.0, 0.4]
    _, face, normal = caster.cast(eye[None], np.array([[0.0, 0.0, -1.0]]))
    assert scene.objects[scene.face_object[face[0]]] == 'wrench'
    assert normal[0, 2] > 0.9


def test_contact_pieces_follow_the_surface_that_sensors_see():
    """No convex piece reaches farther into free space than a third of the robot's radius."""
    scene = load_scene('S0')
    caster = RayCaster(scene)
    for hull in scene.hulls:
        points = trimesh.sample.sample_surface(trimesh.convex.convex_hull(hull), 300, seed=0)[0]
        # Short of rub strips and ports.
        reachable = points[np.hypot(points[:, 1], points[:, 2]) < 1.46]
        if len(reachable):
            assert caster.clearance(reachable).max() < 0.0067


def test_box_measures_70_by_70_by_60_cm_inside():
    centre = np.tile([0.1, 0.1, 0.3], (6, 1))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    distance, _, normal = RayCaster(load_scene('R0')).cast(centre, axes)
    np.testing.assert_allclose(distance, [0.25, 0.25, 0.30, 0.45, 0.45, 0.30], atol=1e-6)
    np.testing.assert_allclose(normal, -axes, atol=1e-12)


def test_each_box_scene_has_one_more_object_and_room_for_the_arm():
    robot = load_robot('soft_arm')
    arm = np.array(robot.base.xyz) - np.linspace(0.06, robot.length, 60)[:, None] * [0.0, 0.0, 1.0]
    names = ['mustard_bottle', 'cup', 'cracker_box', 'wet_floor_sign']
    for count in range(5):
        scene = load_scene(f'R{count}')
        assert [anomaly.name for anomaly in scene.anomalies] == names[:count]
        assert RayCaster(scene).clearance(arm).min() > robot.radius + 0.02


def test_box_objects_stand_on_the_floor_inside_the_box():
    for anomaly in load_scene('R4').anomalies:
        assert anomaly.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
        assert np.abs(anomaly.vertices[:, :2]).max() < 0.35
        assert anomaly.vertices[:, 2].max() < 0.60


def test_loaded_scenes_are_shared_and_cannot_be_changed():
    scene = load_scene('R1')
    assert load_scene('R1') is scene
    with pytest.raises(ValueError, match='read-only'):
        scene.vertices[0] = 0.0


@pytest.mark.parametrize('name', ['S10', 'R5', 'engine', 'scene.step'])
def test_unknown_scene_is_refused_with_the_valid_names(name):
    with pytest.raises(SceneError, match=rf"no scene '{name}'.*S0.*R4.*\.stl"):
        load_scene(name)


# The cache of built scenes.


def small_scene(name: str = 'small') -> Scene:
    zeros = np.zeros(12, dtype=np.int32)
    vertices, faces = np.array(CUBE.vertices), np.array(CUBE.faces, dtype=np.int32)
    anomaly = Anomaly('lump', 'added', vertices.copy(), faces.copy())
    return Scene(
        name,
        vertices,
        faces,
        zeros,
        ('cube',),
        np.full(12, 0.5),
        (vertices[:4].copy(), vertices[2:].copy()),
        (anomaly, anomaly),
    )


def test_cache_gives_back_the_scene_and_builds_it_once(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    source = tmp_path / 'generator.py'
    source.write_text('v1')
    built = []

    def build() -> Scene:
        built.append(1)
        return small_scene()

    first, second = (
        scene_cache.cached_scene('small', GENERATOR, build, [source]) for _ in range(2)
    )
    assert len(built) == 1
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.hulls[1], second.hulls[1])
    assert len(second.hulls) == 2 and second.objects == ('cube',)
    assert second.anomalies[1].kind == 'added' and second.anomalies[1].faces.shape == (12, 3)
    source.write_text('v2')
    scene_cache.cached_scene('small', GENERATOR, build, [source])
    assert len(built) == 2  # a changed generator never meets an old entry


def test_cache_entry_cut_short_is_built_again(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    scene_cache.cached_scene('small', GENERATOR, small_scene)
    entry = next(cache_folder(scene_cache.KIND).glob('*.npz'))
    entry.write_bytes(entry.read_bytes()[:200])
    assert scene_cache.cached_scene('small', GENERATOR, small_scene).faces.shape == (12, 3)


def test_no_cache_folder_costs_time_only(tmp_path, monkeypatch):
    (tmp_path / 'file').write_text('in the way')
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'file'))
    assert scene_cache.cached_scene('small', GENERATOR, small_scene).name == 'small'


# A user's own mesh.


def test_own_mesh_becomes_a_scene_with_contact_pieces(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    CUBE.export(tmp_path / 'cube.stl')
    scene = load_scene(tmp_path / 'cube.stl')
    assert len(scene.hulls) == 1
    np.testing.assert_allclose(np.abs(scene.hulls[0]), 0.5, atol=0.02)


@pytest.mark.parametrize('suffix', ['stl', 'obj', 'ply'])
def test_every_format_keeps_the_geometry(tmp_path, monkeypatch, suffix):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    monkeypatch.setattr(mesh_import, 'convex_pieces', lambda *_: ())
    CUBE.export(tmp_path / f'cube.{suffix}')
    mesh = as_trimesh(load_scene(tmp_path / f'cube.{suffix}'))
    assert len(mesh.vertices) == 8 and mesh.is_watertight
    assert mesh.volume == pytest.approx(1.0)


def test_room_given_by_its_inner_surface_gets_walls_outside_it():
    vertices, faces = mesh_import.with_walls(CUBE.vertices, CUBE.faces[:, ::-1])
    walls = RayCaster(scene_of_mesh(vertices, faces))
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(1.1**3 - 1.0)
    points = np.random.default_rng(0).uniform(-0.55, 0.55, (2000, 3))
    np.testing.assert_array_equal(walls.clearance(points) > 0.0, np.abs(points).max(axis=1) < 0.5)


def test_where_coacd_fails_the_mesh_is_cut_with_planes_and_the_process_goes_on(
    monkeypatch, caplog
):
    monkeypatch.setattr(convex, '_MODULE', 'continuum_loc.no_such_module')
    (piece,) = convex.convex_pieces(CUBE.vertices, CUBE.faces, 'part.stl')
    assert 'part.stl: CoACD failed' in caplog.text and 'No module named' in caplog.text
    np.testing.assert_allclose(np.abs(piece), 0.5, atol=1e-9)


def wall_with_a_window():
    return trimesh.creation.box((1.0, 0.02, 1.0)), trimesh.creation.box((0.3, 0.1, 0.3))


def pipe():
    whole, bore = (trimesh.creation.cylinder(r, 0.4, sections=48) for r in (0.11, 0.1))
    bore.apply_scale((1.0, 1.0, 1.5))
    return whole, bore


def hollow_block():
    return trimesh.creation.box((0.5, 0.4, 0.3)), trimesh.creation.box((0.4, 0.3, 0.2))


@pytest.mark.parametrize('make', [wall_with_a_window, pipe, hollow_block])
def test_plane_cuts_leave_bores_windows_and_cavities_open(make):
    """All matter is in the pieces, and none stands out of it by more than about the tolerance."""
    solid = trimesh.boolean.difference(make(), engine='manifold')
    pieces = list(cutting.pieces(solid.vertices, solid.faces, 0.003))
    hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
    assert len(pieces) < 60
    assert sum(hull.volume for hull in hulls) == pytest.approx(solid.volume, rel=0.2)
    caster = RayCaster(scene_of_mesh(solid.vertices, solid.faces))
    rng = np.random.default_rng(0)
    outline = np.concatenate([hull.sample(500, seed=int(rng.integers(1e6))) for hull in hulls])
    assert caster.clearance(outline).max() < 0.003 + 1e-5
    points = rng.uniform(*solid.bounds, (20_000, 3))
    matter = points[caster.clearance(points) < -1e-4]
    inside = np.any([inside_hull(hull, matter) for hull in hulls], axis=0)
    assert len(matter) > 500 and inside.all()


def inside_hull(hull, points):
    offsets = np.einsum('ij,ij->i', hull.face_normals, hull.triangles_center)
    return np.all(points @ hull.face_normals.T < offsets + 2e-5, axis=1)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_plane_cuts_of_any_heap_of_boxes_are_its_matter(seed):
    rng = np.random.default_rng(seed)
    boxes = [
        trimesh.creation.box(
            rng.uniform(0.02, 0.3, 3),
            trimesh.transformations.random_rotation_matrix(rng.random(3)),
        ).apply_translation(rng.uniform(-0.1, 0.1, 3))
        for _ in range(rng.integers(1, 5))
    ]
    heap = trimesh.boolean.union(boxes, engine='manifold')
    pieces = list(cutting.pieces(heap.vertices, heap.faces, 0.004))
    hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
    caster = RayCaster(scene_of_mesh(heap.vertices, heap.faces))
    assert caster.clearance(np.concatenate(pieces)).max() < 1e-4
    outline = np.concatenate([hull.sample(300, seed=1) for hull in hulls])
    assert caster.clearance(outline).max() < 0.004 + 1e-5
    assert sum(hull.volume for hull in hulls) > 0.999 * heap.volume


def shell(thickness=0.004):
    """Make a quarter of a bent plate, as thin as the tolerance: slices of it look flat."""
    outer, inner = (trimesh.creation.cylinder(r, 0.3, sections=96) for r in (0.4, 0.4 - thickness))
    inner.apply_scale((1.0, 1.0, 1.5))
    quarter = trimesh.creation.box((0.4, 0.4, 0.3)).apply_translation((0.2, 0.2, 0.0))
    plate = trimesh.boolean.difference([outer, inner], engine='manifold')
    return trimesh.boolean.intersection([plate, quarter], engine='manifold')


def disc_with_a_stub():
    """Make a thin disc, and a small stub on it that its hull has to reach."""
    disc = trimesh.creation.cylinder(0.4, 0.02, sections=96)
    stub = trimesh.creation.cylinder(0.002, 0.05, sections=8).apply_translation((0.3, 0.0, 0.02))
    return trimesh.boolean.union([disc, stub], engine='manifold')


@pytest.mark.parametrize(('make', 'most'), [(shell, 20), (disc_with_a_stub, 6)])
def test_thin_pieces_keep_the_tolerance_and_are_no_pile_of_slices(make, most):
    solid = make()
    pieces = list(cutting.pieces(solid.vertices, solid.faces, 0.004))
    assert len(pieces) <= most
    scene = scene_of_mesh(solid.vertices, solid.faces)
    assert standing_out(scene, pieces).max() < 0.004 + 1e-5
    assert min(np.ptp(piece, axis=0).max() for piece in pieces) > 0.004


@given(arrays(float, (4, 3), elements=st.floats(-1.0, 1.0)))
@settings(max_examples=200, deadline=None)
def test_distance_to_a_triangle_is_trimeshs(points):
    point, *corners = points
    nearest = trimesh.triangles.closest_point(np.array([corners]), point[None])[0]
    if np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) > 1e-4:
        found = cutting._to_triangle(point, np.array(corners))
        assert np.sqrt(found) == pytest.approx(np.linalg.norm(nearest - point), abs=1e-6)


def test_large_meshes_are_cut_in_tiles_and_the_cost_is_said_first(caplog):
    fine = trimesh.creation.icosphere(5, 0.2)
    assert len(fine.faces) > convex.SMALL
    pieces = convex.convex_pieces(fine.vertices, fine.faces, 'ball.stl')
    assert 'ball.stl: cutting 20480 faces' in caplog.text
    volume = sum(trimesh.convex.convex_hull(piece).volume for piece in pieces)
    assert volume == pytest.approx(fine.volume, rel=1e-3)


@pytest.mark.parametrize('content', [b'', b'ply\nfoo', b'solid x\nendsolid x\n'])
@pytest.mark.parametrize('suffix', ['stl', 'obj', 'ply'])
def test_file_that_is_no_mesh_is_refused_by_name(tmp_path, content, suffix):
    path = tmp_path / f'broken.{suffix}'
    path.write_bytes(content)
    with pytest.raises(SceneError, match=r'broken'):
        load_scene(path)


def test_cloud_of_points_is_no_scene(tmp_path):
    path = tmp_path / 'points.ply'
    trimesh.PointCloud(CUBE.vertices).export(path)
    with pytest.raises(SceneError, match='no faces; export a triangle mesh'):
        load_scene(path)


def test_absent_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match='no such file'):
        load_scene(tmp_path / 'absent.stl')


@given(st.sets(st.integers(0, 11), min_size=1, max_size=11))
@settings(max_examples=50, deadline=None)
def test_any_faces_removed_leave_a_hole_that_is_reported(removed):
    faces = np.delete(CUBE.faces, sorted(removed), axis=0)
    with pytest.raises(SceneError, match=r'part\.stl: \d+ open edges, holes near .* close them'):
        check_mesh(CUBE.vertices, faces, 'part.stl')


@given(st.sets(st.integers(0, 11), min_size=1, max_size=11))
@settings(max_examples=50, deadline=None)
def test_any_faces_turned_over_are_reported(turned):
    faces = CUBE.faces.copy()
    faces[sorted(turned)] = faces[sorted(turned)][:, ::-1]
    with pytest.raises(SceneError, match='look opposite ways'):
        check_mesh(CUBE.vertices, faces, 'part.stl')


@given(st.floats(1e-6, 1e6))
@settings(max_examples=100, deadline=None)
def test_size_is_accepted_from_5_cm_to_50_m(scale):
    if 0.05 <= scale <= 50.0:
        check_mesh(CUBE.vertices * scale, CUBE.faces, 'part.stl')
    else:
        advice = 'scale it by 0.001' if 50.0 < scale <= 50_000.0 else 'must lie between'
        with pytest.raises(SceneError, match=advice):
            check_mesh(CUBE.vertices * scale, CUBE.faces, 'part.stl')


def test_degenerate_faces_are_counted_and_placed():
    # On an edge: a face without area.
    vertices = np.concatenate([CUBE.vertices, [[0.5, 0.5, 0.2]]])
    corner, other = (
        int(np.argmin(np.linalg.norm(vertices - [0.5, 0.5, z], axis=1))) for z in (-0.5, 0.5)
    )
    faces = np.concatenate([CUBE.faces, [[corner, other, 8]]])
    with pytest.raises(
        SceneError, match=r'1 degenerate faces without area, the first is face 12 at \(0\.500'
    ):
        check_mesh(vertices, faces, 'part.stl')


def test_vertex_that_is_not_finite_is_named():
    vertices = CUBE.vertices.copy()
    vertices[3, 1] = np.nan
    with pytest.raises(SceneError, match='vertex 3'):
        check_mesh(vertices, CUBE.faces, 'part.stl')
