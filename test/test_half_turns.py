"""Rotations by half a turn, where the quaternion's scalar part vanishes."""

from continuum_loc import lie, lie_kernels
import numpy as np
import pytest

AXES = [*np.eye(3), *-np.eye(3), *(np.array([[1, 1, 0], [1, 0, 1], [0, 1, 1]]) / np.sqrt(2.0))]


@pytest.mark.parametrize('axis', AXES)
@pytest.mark.parametrize('short', [0.0, 1e-12, 1e-6, 1e-3])
def test_a_compiled_logarithm_of_a_half_turn_is_as_long_as_it_is(axis, short):
    """Each axis takes another branch, as another component is the largest."""
    T, back = lie.exp(np.array([0.3, -0.2, 0.5, *((np.pi - short) * axis)])), np.empty(6)
    lie_kernels.log(T, back)
    assert np.linalg.norm(back[3:]) == pytest.approx(np.pi - short, abs=1e-9)
    np.testing.assert_allclose(lie.exp(back), T, atol=1e-9)
    np.testing.assert_allclose(lie.exp(lie.log(T)), T, atol=1e-9)
