"""Maps: blue noise with exact normals, the planarity of the paper, files that lose nothing."""

import json
import struct
import zipfile

from continuum_loc.errors import MapError
from continuum_loc.mapping.build import DENSITY, local_shape, map_from_cloud, sample_mesh
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import NPZ_FORMAT, PriorMap
from continuum_loc.mapping.scale import check_scale, map_for, size_note
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.settings import dump_settings
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
import trimesh


def box_map(size=(1.0, 1.0, 1.0), **options):
    mesh = trimesh.creation.box(size)
    return sample_mesh(mesh.vertices, mesh.faces, **({'spacing': 0.03} | options))


def test_no_two_samples_are_closer_than_the_spacing_and_none_is_far_from_the_others():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    prior = sample_mesh(sphere.vertices, sphere.faces, spacing=0.05)
    tree = cKDTree(prior.points)
    assert tree.query(prior.points, k=2)[0][:, 1].min() >= 0.05
    anywhere, _ = trimesh.sample.sample_surface(sphere, 20_000, seed=1)
    assert np.quantile(tree.query(anywhere)[0], 0.999) < 1.25 * 0.05  # hardly a hole


def test_density_is_the_stated_one():
    prior = box_map(spacing=0.02)
    assert len(prior) * 0.02**2 / 6.0 == pytest.approx(DENSITY, rel=0.03)
    assert len(box_map(spacing=None, count=20_000)) == pytest.approx(20_000, rel=0.03)


def test_both_sides_of_a_thin_blade_are_sampled_with_their_own_normals():
    prior = box_map((1.0, 1.0, 0.002))
    top, bottom = prior.points[:, 2] > 0.0009, prior.points[:, 2] < -0.0009
    middle = np.abs(prior.points[:, :2]).max(axis=1) < 0.4
    np.testing.assert_allclose(
        prior.normals[top & middle], np.tile([0, 0, 1.0], ((top & middle).sum(), 1)), atol=1e-9
    )
    np.testing.assert_allclose(prior.normals[bottom & middle][:, 2], -1.0)
    assert (top & middle).sum() == pytest.approx((bottom & middle).sum(), rel=0.1)
    # PCA over both sides would see a slab; one side alone is a plane.
    assert prior.planarity[middle].min() > 0.4


def test_the_same_seed_gives_the_same_map_and_another_seed_another():
    a, b, c = box_map(seed=1), box_map(seed=1), box_map(seed=2)
    np.testing.assert_array_equal(a.table, b.table)
    assert not np.array_equal(a.points[:50], c.points[:50])


def test_planarity_is_one_on_a_round_patch_zero_on_a_line_and_low_at_an_edge():
    ring = np.array(
        [[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
    )
    disc = np.concatenate([[[0.0, 0.0, 0.0]], ring])
    line = np.column_stack([np.arange(10.0), np.zeros((10, 2))])
    assert local_shape(disc, None, neighbours=13)[0][0] == pytest.approx(1.0)
    assert local_shape(line, None, neighbours=5)[0].max() < 1e-6
    prior = box_map(spacing=0.02)
    to_edge = np.sort(0.5 - np.abs(prior.points), axis=1)[:, 1]
    assert prior.planarity[to_edge < 0.01].mean() < 0.5 * prior.planarity[to_edge > 0.15].mean()


def test_planarity_is_the_papers_formula():
    points = np.random.default_rng(0).normal(size=(12, 3))
    sigma = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))[::-1]
    alpha, directions = local_shape(points, None, neighbours=12)
    np.testing.assert_allclose(alpha, (sigma[1] - sigma[2]) / sigma[0], rtol=1e-9)
    least = np.linalg.eigh(np.cov(points.T))[1][:, 0]
    np.testing.assert_allclose(np.abs(directions @ least), 1.0, rtol=1e-9)


def test_normals_of_a_bare_cloud_turn_toward_the_viewpoint_or_the_map_says_they_do_not():
    sphere = trimesh.creation.icosphere(subdivisions=4).vertices
    inside = map_from_cloud(sphere, viewpoint=np.zeros(3))
    assert inside.oriented and np.all(np.einsum('ij,ij->i', inside.normals, -inside.points) > 0.9)
    assert not map_from_cloud(sphere).oriented


@pytest.mark.parametrize('suffix', ['.npz', '.ply', '.csv', '.xyz'])
def test_files_give_back_what_was_saved(tmp_path, suffix):
    prior = box_map()
    prior.save(tmp_path / f'map{suffix}')
    loaded = load_map(tmp_path / f'map{suffix}')
    np.testing.assert_allclose(loaded.table, prior.table, atol=1e-8)
    assert loaded.oriented and loaded.source.endswith(suffix)
    assert loaded.spacing == pytest.approx(prior.spacing, rel=0.3)
    if suffix == '.npz':
        assert (loaded.spacing, loaded.sigma, loaded.seed) == (
            prior.spacing,
            prior.sigma,
            prior.seed,
        )


@settings(max_examples=40, deadline=None)
@given(
    hnp.arrays(
        np.float64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-1e3, 1e3)
    )
)
def test_any_finite_table_of_xyz_is_read_whole_and_in_order(tmp_path_factory, points):
    path = tmp_path_factory.mktemp('maps') / 'cloud.csv'
    np.savetxt(path, points, delimiter=',', header='x,y,z', comments='', fmt='%.17g')
    np.testing.assert_array_equal(load_map(path).points, points)


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=200))
def test_any_text_is_either_a_map_or_a_map_error(tmp_path_factory, text):
    path = tmp_path_factory.mktemp('maps') / 'cloud.csv'
    path.write_text(text)
    try:
        assert np.isfinite(load_map(path).points).all()
    except MapError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize('suffix', ['.stl', '.obj', '.ply'])
def test_meshes_are_sampled(tmp_path, suffix):
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / f'box{suffix}')
    prior = load_map(tmp_path / f'box{suffix}', spacing=0.01)
    assert len(prior) == pytest.approx(DENSITY * 0.22 / 0.01**2, rel=0.1)
    on_a_side = np.abs(np.abs(prior.points) - [0.05, 0.1, 0.15]).min(axis=1)
    assert on_a_side.max() < 1e-6


def test_pcd_clouds_are_read(tmp_path):
    rows = '\n'.join(f'{i} {j} 0' for i in range(5) for j in range(5))
    (tmp_path / 'c.pcd').write_text(
        'VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 25\nHEIGHT 1\n'
        f'VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 25\nDATA ascii\n{rows}\n'
    )
    prior = load_map(tmp_path / 'c.pcd', viewpoint=[0.0, 0.0, 5.0])
    assert len(prior) == 25 and np.allclose(prior.normals, [0, 0, 1])


@pytest.mark.parametrize(
    ('name', 'text', 'said'),
    [
        ('a.csv', 'x,y,z\n1,2,3\n4,five,6\n7,8,x\n', r'line 3.*4,five,6.*\(2 such lines\)'),
        ('a.csv', 'x,y,z\n1,2,3\n4,5\n', 'line 3: expected 3 numbers'),
        ('a.csv', 'x,u,y\n1,2,3\n', 'line 1: columns x,u,y; needed are x, y and z'),
        ('a.csv', '1,2,3,4\n', '4 columns; valid are'),
        ('a.csv', 'x,y,z\n', 'holds no points'),
        ('a.csv', 'x,y,z\n1,2,3\nnan,0,0\n', '1 of 2 points are not finite.*number 1'),
        (
            'a.csv',
            'x,y,z,nx,ny,nz\n1,2,3,0,0,1\n1,2,3,0,0,0\n',
            r'1 of 2 normals .* number 1 \(line 3\), of length 0',
        ),
        (
            'a.csv',
            'x,y,z,nx,ny,nz,planarity\n1,2,3,0,0,1,1.5\n',
            r'planarity must lie in \[0, 1\]',
        ),
        ('a.las', '', "cannot be read as '.las'; valid are .npz, .ply"),
        ('a.npz', 'junk', 'not a map written by'),
        ('a.ply', 'ply\nrubbish', 'a.ply'),
        ('a.stl', 'solid\nendsolid', 'a.stl'),
    ],
)
def test_unusable_files_say_where_and_what_is_valid(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(MapError, match=said):
        load_map(tmp_path / name)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match='nowhere.ply: there is no such file'):
        load_map(tmp_path / 'nowhere.ply')


@pytest.mark.parametrize(
    ('changed', 'said'),
    [
        ({'normals': np.array([[0, 0, 2.0]])}, 'length 1'),
        ({'planarity': np.array([np.nan])}, 'planarity'),
        ({'planarity': np.zeros(2)}, r'planarity \(P,\)'),
        ({'sigma': 0.0}, 'sigma'),
        ({'points': np.array([[np.inf, 0, 0]])}, 'finite'),
    ],
)
def test_a_map_cannot_hold_nonsense(changed, said):
    parts = {
        'points': np.zeros((1, 3)),
        'normals': np.array([[0, 0, 1.0]]),
        'planarity': np.ones(1),
    }
    with pytest.raises(MapError, match=said):
        PriorMap(**(parts | changed))


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        ({'spacing': None}, 'either spacing or count'),
        ({'spacing': 0.1, 'count': 5}, 'either'),
        ({'spacing': -1.0}, '> 0'),
        ({'spacing': None, 'count': 0}, '> 0'),
    ],
)
def test_sampling_refuses_what_it_cannot_do(options, said):
    with pytest.raises(MapError, match=said):
        box_map(**options)


# Our own archive: what it promises, and what it may hold


def array_file(shape, data=b'', kind='<f8'):
    """Write an array of NumPy, whose header may promise what the data do not hold."""
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}".encode()
    header = header.ljust(117) + b'\n'
    return b'\x93NUMPY\x01\x00' + struct.pack('<H', len(header)) + header + data


def archive(path, changed=None, about=None, packing=zipfile.ZIP_STORED):
    """Write a map of one point at (1, 2, 3) by hand, with members changed or left out (None)."""
    about = {'sigma': 0.001, 'spacing': 0.01, 'oriented': True} | (about or {})
    text = json.dumps(about)
    members = {
        'format.npy': array_file((), NPZ_FORMAT.encode('utf-32-le'), f'<U{len(NPZ_FORMAT)}'),
        'about.npy': array_file((), text.encode('utf-32-le'), f'<U{len(text)}'),
        'points.npy': array_file((1, 3), struct.pack('<3d', 1, 2, 3)),
        'normals.npy': array_file((1, 3), struct.pack('<3d', 0, 0, 1)),
        'planarity.npy': array_file((1,), struct.pack('<d', 1)),
    } | (changed or {})
    with zipfile.ZipFile(path, 'w', packing) as written:
        for name, data in members.items():
            if data is not None:
                written.writestr(name, data)
    return path


def test_an_archive_by_hand_is_read(tmp_path):
    prior = load_map(archive(tmp_path / 'map.npz', about={'notes': ['left aside: r']}))
    np.testing.assert_array_equal(prior.table, [[1, 2, 3, 0, 0, 1, 1]])
    assert (prior.sigma, prior.spacing, prior.notes) == (0.001, 0.01, ('left aside: r',))


@pytest.mark.parametrize(
    ('changed', 'said'),
    [
        ({'points.npy': array_file((10**12, 3))}, 'which are 24,000,000,000,000 bytes'),
        ({'points.npy': array_file((2**62, 8), bytes(24))}, 'and holds 24'),
        ({'points.npy': array_file((1, 3), bytes(16))}, 'are 24 bytes, and holds 16'),
        ({'points.npy': array_file((1, 3), bytes(32))}, 'are 24 bytes, and holds 32'),
        ({'points.npy': array_file((1,), b'cos', '|O')}, 'holds objects, not numbers'),
        ({'points.npy': array_file((3,), bytes(24))}, r'expected points \(P, 3\)'),
        ({'points.npy': array_file((1, 3), struct.pack('<3d', 1, 2, np.inf))}, 'must be finite'),
        ({'points.npy': array_file((1, 3), struct.pack('<3d', 1, 2, 1e12))}, 'within 1e.09 m'),
        ({'points.npy': array_file((1, 3), b'a   b   c   ', '<U1')}, 'points are of type <U1'),
        ({'points.npy': b'PK'}, 'not a map written by'),
        ({'points.npy': None}, 'not a map written by'),
        ({'about.npy': None}, 'not a map written by'),
        ({'format.npy': None}, "format 'None', expected"),
    ],
)
def test_an_archive_that_lies_is_refused(tmp_path, changed, said):
    with pytest.raises(MapError, match=rf'map\.npz: .*{said}'):
        load_map(archive(tmp_path / 'map.npz', changed))


@pytest.mark.parametrize(
    'about',
    [
        {'sigma': float('nan')},
        {'sigma': float('inf')},
        {'sigma': 'large'},
        {'sigma': True},
        {'spacing': -1.0},
        {'oriented': 1},
        {'notes': 'a'},
        {'notes': [1]},
        {'colour': 'red'},
    ],
)
def test_what_an_archive_says_about_its_map_is_checked(tmp_path, about):
    with pytest.raises(MapError, match=r'map\.npz: '):
        load_map(archive(tmp_path / 'map.npz', about=about))


def test_an_archive_that_unfolds_to_gigabytes_is_refused(tmp_path):
    zeros = array_file((125_000_000,), bytes(1_000_000_000))
    path = archive(tmp_path / 'map.npz', {'zeros.npy': zeros}, packing=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 2_000_000
    with pytest.raises(MapError, match='would unfold to 1,000,00'):
        load_map(path)


# Units and notes


def cube_map(edge):
    return box_map((edge, edge, edge), spacing=0.03 * edge)


def small_robot(**changed):
    """Describe a robot of 0.5 m at the origin, with one ToF sensor at its tip."""
    data = {
        'name': 'mine',
        'length': 0.5,
        'radius': 0.01,
        'rings': [{'name': 'tip', 's': 0.5}],
        'tof': [{'name': 'eye', 'ring': 'tip', 'mount': {'azimuth_deg': 0, 'radius': 0.01}}],
    }
    return RobotDescription.model_validate(data | changed)


def test_a_map_in_millimetres_is_refused_and_scaled_it_is_read(tmp_path):
    """A box of 2 m about a robot of 0.5 m has ratio 4; in millimetres 4000."""
    robot = small_robot()
    assert check_scale(robot, cube_map(2.0)) == ()
    cube_map(2000.0).save(tmp_path / 'mm.npz')
    with pytest.raises(MapError, match='measures 2000 m and .* millimetres.*--scale 0.001'):
        map_for(robot, tmp_path / 'mm.npz')
    assert 'looks like millimetres' in size_note(load_map(tmp_path / 'mm.npz'))[0]
    scaled = load_map(tmp_path / 'mm.npz', scale=0.001)
    assert np.ptp(scaled.points, axis=0) == pytest.approx([2.0] * 3, rel=1e-3)
    assert scaled.spacing == pytest.approx(0.06) and scaled.sigma == pytest.approx(1e-7)
    assert scaled.notes == ('lengths multiplied by 0.001',)
    assert check_scale(robot, scaled) == () and size_note(scaled) == ()


def test_a_map_a_thousand_times_too_small_is_refused():
    with pytest.raises(MapError, match='measures 0.002 m and .* robot description looks like'):
        check_scale(small_robot(), cube_map(0.002))
    assert '--scale 1000' in size_note(cube_map(0.002))[0]


def wall_map(edge, spacing):
    """Four corners of a wall of this edge, said to have points between them."""
    points = np.array([[0, 0, 0], [edge, 0, 0], [0, edge, 0], [edge, edge, 0]])
    return PriorMap(points, np.tile([0, 0, 1.0], (4, 1)), np.ones(4), spacing=spacing)


@pytest.mark.parametrize(('edge', 'spacing'), [(0.03, 0.001), (40.0, 0.01)])
def test_a_map_of_an_odd_size_is_told(edge, spacing):
    """A sixteenth of the robot's length, and eighty times it."""
    (note,) = check_scale(small_robot(), wall_map(edge, spacing))
    assert 'are both in metres?' in note


def test_a_map_of_eighty_reaches_with_points_half_a_reach_apart_is_in_millimetres():
    with pytest.raises(MapError, match='looks like millimetres'):
        check_scale(small_robot(), wall_map(40.0, 0.25))


def test_stray_points_of_a_scanner_do_not_make_a_map_large():
    prior = cube_map(2.0)
    strays = prior.points.copy()
    strays[: len(strays) // 500] += 5000.0
    assert check_scale(small_robot(), map_from_cloud(strays, prior.normals)) == ()


def test_a_base_far_from_the_map_is_told():
    """The tip at 0.5 m sees 4 m far; the nearest side of the box is 99 m away."""
    robot = small_robot(base={'xyz': [100.0, 0.0, 0.0]})
    (note,) = check_scale(robot, cube_map(2.0))
    assert "99 m away from the base of robot 'mine', whose sensors see 4.5 m far" in note


def test_a_robot_that_uses_no_map_is_not_compared_with_one():
    assert check_scale(load_robot('hall_arm'), cube_map(5000.0)) == ()


@pytest.mark.parametrize('scale', [0.0, -1.0, float('nan'), float('inf')])
def test_a_scale_that_is_none_is_refused(tmp_path, scale):
    cube_map(1.0).save(tmp_path / 'map.npz')
    with pytest.raises(MapError, match='scale must be > 0'):
        load_map(tmp_path / 'map.npz', scale=scale)


def test_meshes_and_clouds_are_scaled_and_given_a_sigma(tmp_path):
    trimesh.creation.box((1000.0, 1000.0, 1000.0)).export(tmp_path / 'part.stl')
    prior = load_map(tmp_path / 'part.stl', scale=0.001, spacing=0.05, sigma=0.002)
    assert np.abs(prior.points).max() == pytest.approx(0.5)
    assert (prior.spacing, prior.sigma) == (0.05, 0.002)
    (tmp_path / 'cloud.xyz').write_text('0 0 0\n1000 0 0\n0 500 0\n')
    cloud = load_map(tmp_path / 'cloud.xyz', scale=0.001, sigma=0.003)
    np.testing.assert_allclose(cloud.points[1], [1.0, 0.0, 0.0])
    assert cloud.sigma == 0.003


def test_what_was_left_aside_stays_with_a_map_that_is_converted(tmp_path):
    (tmp_path / 'a.csv').write_text('x,y,z,red\n0,0,0,9\n1,0,0,9\n0,1,0,9\n')
    load_map(tmp_path / 'a.csv').save(tmp_path / 'b.npz')
    assert load_map(tmp_path / 'b.npz').notes == ('left aside: red',)


def test_the_bundled_robots_fit_maps_of_their_scenes(tmp_path):
    robot = load_robot('engine')
    dump_settings(robot, tmp_path / 'robot.yaml')
    assert load_robot(tmp_path / 'robot.yaml').model_dump() == robot.model_dump()
    assert check_scale(robot, box_map((1.5, 1.5, 1.5), spacing=0.05)) == ()
