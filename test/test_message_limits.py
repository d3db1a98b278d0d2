"""Messages at the edges of what is valid, and what the errors say of them."""

from types import SimpleNamespace

from continuum_loc.errors import MapError, MessageError
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import PriorMap
from msg_tools.clouds import columns_cloud
from msg_tools.convert import header_message, stamp_of, transforms_of
from msg_tools.drivers import fbg_sample
from msg_tools.factory import bag_messages
import numpy as np
import pytest

MAKE = bag_messages()


def header(sec: int, nanosec: int):
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id='a')


@pytest.mark.parametrize(
    ('sec', 'nanosec', 'stamp'),
    [(0, 0, 0), (0, 999_999_999, 999_999_999), (2, 1, 2_000_000_001)],
)
def test_a_stamp_is_seconds_and_less_than_one_of_nanoseconds(sec, nanosec, stamp):
    assert stamp_of(header(sec, nanosec), 'here') == stamp


@pytest.mark.parametrize(('sec', 'nanosec'), [(-1, 0), (0, 1_000_000_000), (0, -1)])
def test_other_stamps_are_no_time(sec, nanosec):
    with pytest.raises(MessageError, match=f'here: stamp {sec} s {nanosec} ns is not a time'):
        stamp_of(header(sec, nanosec), 'here')


def pose(*quaternion):
    place = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    turn = dict(zip('xyzw', quaternion, strict=True))
    return SimpleNamespace(position=place, orientation=SimpleNamespace(**turn))


def test_the_worst_quaternion_is_the_one_that_is_told():
    """Of norms 1.005, 0.5 and 1.2 the second is farthest from 1, the first may pass."""
    fine = pose(0.0, 0.0, 0.0, 1.005)
    with pytest.raises(MessageError, match='norm 0.5; valid: 1 within 0.01'):
        transforms_of([fine, pose(0.0, 0.5, 0.0, 0.0), pose(1.2, 0.0, 0.0, 0.0)], 'here')
    np.testing.assert_allclose(transforms_of([fine], 'here')[0, :3, 3], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ('name', 'row', 'dense'),
    [(None, 0, True), ('x', 3, False), ('z', 9999, False), ('sigma', 5000, True)],
)
def test_a_cloud_is_dense_where_every_place_is_finite(name, row, dense):
    """Wherever in it the one place is that is not; other columns may lack values."""
    columns = {key: np.zeros(10_000) for key in ('x', 'y', 'z', 'sigma')}
    if name is not None:
        columns[name][row] = np.nan
    message = columns_cloud(MAKE, header_message(MAKE, 1, 'map'), columns)
    assert bool(message.is_dense) is dense
    assert (message.height, message.width, message.row_step) == (1, 10_000, 160_000)


def test_a_cloud_that_is_cut_says_what_its_head_asks_for():
    from msg_tools.clouds import cloud_array

    columns = {key: np.zeros(4) for key in 'xyz'}
    message = columns_cloud(MAKE, header_message(MAKE, 1, 'map'), columns)
    message.data = message.data[:-1]
    with pytest.raises(MessageError, match=r'47 bytes.*1 x 48 asks for 48'):
        cloud_array(message, 'here')


@pytest.mark.parametrize(('cores', 'enough'), [(2, False), (3, True), (4, True), (7, True)])
def test_a_fibre_has_three_cores_or_more(cores, enough):
    azimuth = np.linspace(0.0, 360.0, cores, endpoint=False)
    strain = -2.0 * 1e-3 * np.cos(np.radians(azimuth) - 0.5)
    if enough:
        assert fbg_sample(1, [0.1], [strain], azimuth, 1e-3).kappa[0] == pytest.approx(2.0)
        return
    with pytest.raises(MessageError, match='at least 3 cores'):
        fbg_sample(1, [0.1], [strain], azimuth, 1e-3)


def test_stations_and_strains_must_be_as_many():
    azimuth = [0.0, 120.0, 240.0]
    with pytest.raises(MessageError, match=r'shape \(2, 3\) for 1 stations and 3 cores'):
        fbg_sample(1, [0.1], np.zeros((2, 3)), azimuth, 1e-3)


@pytest.mark.parametrize('told', ['0', 'zzz', ''])
def test_a_map_of_another_format_is_refused(tmp_path, told):
    """Whether its name comes before or after ours in the alphabet."""
    prior = PriorMap(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    prior.save(tmp_path / 'map.npz')
    with np.load(tmp_path / 'map.npz') as data:
        arrays = dict(data)
    np.savez(tmp_path / 'other.npz', **{**arrays, 'format': told})
    with pytest.raises(MapError, match=f"format '{told}'"):
        load_map(tmp_path / 'other.npz')
    assert len(load_map(tmp_path / 'map.npz')) == 1
