"""Maps: blue noise with exact normals, the planarity of the paper, files that lose nothing."""

from continuum_loc.errors import MapError
from continuum_loc.mapping.build import DENSITY, local_shape, map_from_cloud, sample_mesh
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import PriorMap
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


def test_a_region_confines_the_samples():
    prior = box_map(region=(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 0.2])))
    assert prior.points[:, 2].min() >= 0.0 and prior.points[:, 2].max() <= 0.2


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
        ('a.csv', 'x,z,y\n1,2,3\n', 'line 1: columns x,z,y; valid are x,y,z or'),
        ('a.csv', '1,2,3,4\n', '4 columns; valid are'),
        ('a.csv', 'x,y,z\n', 'holds no points'),
        ('a.csv', 'x,y,z\n1,2,3\nnan,0,0\n', '1 of 2 points are not finite.*number 1'),
        ('a.csv', 'x,y,z,nx,ny,nz\n1,2,3,0,0,0\n', '1 of 1 normals have length 0'),
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
        ({'region': (np.full(3, 5.0), np.full(3, 6.0))}, 'region'),
    ],
)
def test_sampling_refuses_what_it_cannot_do(options, said):
    with pytest.raises(MapError, match=said):
        box_map(**options)
