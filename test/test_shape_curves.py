"""
Curves: exact on what they are made for, whole on S-shapes and in space.

And straight without failing.
"""

from continuum_loc import lie
from continuum_loc.robot import load_robot
from continuum_loc.shape import curves
from continuum_loc.simulator.hall_arm import Arm, bent, out_of_plane, PERFECT, s_shape
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from studies.support.shape_curves import (
    at_fractions,
    fit_projected,
    printed_quadratic_bezier,
    project,
)

ROBOT = load_robot('hall_arm')
ARM = Arm(ROBOT, PERFECT)
S = np.array([0.0, 0.025, 0.05, 0.075])
FRACTIONS = np.linspace(0.0, 1.0, 301)
METHODS = list(curves.CURVES)
FORMS = [curves.fit_curve, fit_projected]
azimuths = st.floats(-3.1, 3.1)


def sampled(strain):
    """Points and tangents of magnet and modules, and the true backbone between."""
    T = np.concatenate([np.eye(4)[None], ARM.T_base_module(strain)])
    return T[:, :3, 3], T[:, :3, 0], ARM.backbone(strain, S[-1] * FRACTIONS)


def errors(points, truth):
    return np.linalg.norm(at_fractions(points, FRACTIONS) - truth, axis=1)


@given(st.floats(1.0, 30.0), azimuths, st.sampled_from(FORMS))
@settings(max_examples=40, deadline=None)
def test_arc_is_exact_on_arcs(curvature, azimuth, fit):
    points, tangents, truth = sampled(bent(ROBOT, curvature, azimuth))
    curve = fit(points, tangents, 'kasa_arc', samples=2001)
    assert errors(curve, truth).max() < 2e-7
    circle = curves.kasa_circle(project(points))
    assert circle[2] == pytest.approx(1.0 / curvature, rel=1e-9)


@given(st.floats(1.0, 30.0), azimuths)
@settings(max_examples=40, deadline=None)
def test_biarcs_are_exact_on_arcs(curvature, azimuth):
    points, tangents, truth = sampled(bent(ROBOT, curvature, azimuth))
    assert errors(curves.biarc_chain(points, tangents, 2001), truth).max() < 2e-7


def test_quadratic_bezier_converges_on_an_arc_with_the_fourth_power_of_the_angle():
    worst = []
    for curvature in (5.0, 10.0):
        points, tangents, truth = sampled(bent(ROBOT, curvature))
        curve = fit_projected(points, tangents, 'quadratic_bezier', samples=4001)
        # The nearest point, so that only the shape counts.
        gap = np.linalg.norm(curve[:, None] - truth[None], axis=2).min(axis=0)
        radius = np.hypot(*(project(curve) - curves.kasa_circle(project(truth))[:2]).T)
        worst.append(np.abs(radius * curvature - 1.0).max())
        assert gap.max() < 1e-4
    assert worst[1] / worst[0] == pytest.approx(16.0, rel=0.05)


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('fit', FORMS)
def test_straight_is_a_line(method, fit):
    points, tangents, truth = sampled(bent(ROBOT, 0.0))
    curve = fit(points, tangents, method)
    assert np.isfinite(curve).all() and errors(curve, truth).max() < 1e-12


def nearly_straight(noise):
    """Points, tangents and truth of a straight robot; noise (15,) on modules and tangents."""
    points, tangents, truth = sampled(bent(ROBOT, 0.0))
    noise = np.array(noise)
    points = points + np.vstack([np.zeros(3), noise[:9].reshape(3, 3)])
    tangents = tangents + np.column_stack(
        [np.zeros(4), np.append(0.0, noise[9:12]), np.append(0.0, noise[12:15])]
    )
    return points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True), truth


NOISE = st.lists(st.floats(-1e-4, 1e-4), min_size=15, max_size=15)


@given(NOISE, st.sampled_from(METHODS))
@settings(max_examples=200, deadline=None)
def test_nearly_straight_stays_nearly_straight(noise, method):
    """
    Noise on modules and tangents never throws a curve in space far off.

    Up to 0.1 mm on the modules and 1e-4 rad on tangents.
    """
    points, tangents, truth = nearly_straight(noise)
    assert errors(curves.fit_curve(points, tangents, method), truth).max() < 6e-4


@given(NOISE, st.sampled_from(METHODS))
@settings(max_examples=100, deadline=None)
def test_the_projected_forms_do_not_fail_on_noise(noise, method):
    """It can throw the paper's forms off (see the next test), but they give a curve."""
    points, tangents, _ = nearly_straight(noise)
    assert np.isfinite(fit_projected(points, tangents, method)).all()


def test_the_projected_arc_takes_a_zigzag_for_a_bend():
    """
    Distances from the axis are never negative, so noise about it reads as a zigzag.

    It is one-sided, and Kasa's algebraic fit prefers a small circle for it: 0.1 mm of noise
    becomes 1 mm. The spatial arc does not fall for it.
    """
    points, tangents, truth = nearly_straight(
        [0, 0, 7.0e-5, 0, 0, 4.2e-5, 0, 9.5e-5, 5.5e-5, *[0.0] * 6]
    )
    spatial, projected = (errors(fit(points, tangents, 'kasa_arc'), truth).max() for fit in FORMS)
    assert projected > 8e-4
    assert spatial < 2e-4


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize(
    ('strain', 'name'), [(s_shape(ROBOT, 35.0), 'S'), (out_of_plane(ROBOT, 15.0, np.pi), 'space')]
)
def test_spatial_forms_hold_where_the_projection_folds(method, strain, name):
    points, tangents, truth = sampled(strain)
    spatial = errors(curves.fit_curve(points, tangents, method), truth).mean()
    projected = errors(fit_projected(points, tangents, method), truth).mean()
    assert spatial < 4e-4
    assert spatial < 0.5 * projected or name == 'S' and method == 'cubic_bezier'


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize(
    'strain', [bent(ROBOT, 20.0, 0.4), s_shape(ROBOT, 25.0), out_of_plane(ROBOT, 15.0)]
)
def test_spatial_forms_do_not_depend_on_the_frame(method, strain):
    points, tangents, _ = sampled(strain)
    T = lie.exp(np.array([0.1, -0.2, 0.05, 0.7, -1.1, 0.4]))
    R, p = T[:3, :3], T[:3, 3]
    moved = curves.fit_curve(points @ R.T + p, tangents @ R.T, method)
    np.testing.assert_allclose(
        moved, curves.fit_curve(points, tangents, method) @ R.T + p, atol=1e-12
    )


def test_tangent_continuous_forms_keep_the_measured_tangents():
    points, tangents, _ = sampled(out_of_plane(ROBOT, 20.0))
    for build in (curves.quadratic_bezier, curves.biarc_chain):
        curve = build(points, tangents, 6001)
        for m in range(3):
            step = curve[2000 * m + 1] - curve[2000 * m]
            np.testing.assert_allclose(curve[2000 * m], points[m], atol=1e-12)
            np.testing.assert_allclose(step / np.linalg.norm(step), tangents[m], atol=2e-3)


def test_cubic_passes_through_its_four_points_at_thirds():
    points = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_allclose(curves.cubic_bezier(points, None, 4), points, atol=1e-12)


def test_printed_kappa_points_the_wrong_way():
    """
    Tangents of a quarter circle meet at its corner.

    Eq. 14 as printed puts the control point opposite.
    """
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 3.0, 0.0]])
    tangents = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    mended = fit_projected(points, tangents, 'quadratic_bezier', samples=5)
    # (p0 + 2 beta + p1) / 4 with beta = (1, 0).
    np.testing.assert_allclose(mended[1], [0.75, 0.25, 0.0])
    printed = printed_quadratic_bezier(points, tangents, 5)
    np.testing.assert_allclose(printed[1], [-0.25, 0.25, 0.0])


@given(st.floats(0.5, 30.0), azimuths, st.floats(0.076, 0.12))
@settings(max_examples=40, deadline=None)
def test_an_arc_is_carried_on_as_the_same_arc(curvature, azimuth, length):
    points, tangents, _ = sampled(bent(ROBOT, curvature, azimuth))
    curve = curves.extended(curves.fit_curve(points, tangents, samples=601), length)
    angle = curvature * length
    tip = (
        np.array(
            [np.sin(angle), *(1 - np.cos(angle)) * np.array([np.cos(azimuth), np.sin(azimuth)])]
        )
        / curvature
    )
    np.testing.assert_allclose(curve[-1], tip, atol=2e-6)
    assert curves.arclength(curve)[-1] == pytest.approx(length, rel=1e-5)


def test_a_curve_that_is_long_enough_stays_as_it_is():
    points, tangents, _ = sampled(bent(ROBOT, 5.0))
    curve = curves.fit_curve(points, tangents)
    np.testing.assert_array_equal(curves.extended(curve, 0.05), curve)


def test_bad_input_is_named():
    points, tangents, _ = sampled(bent(ROBOT, 5.0))
    with pytest.raises(
        ValueError, match="no curve 'spline'; valid: quadratic_bezier, cubic_bezier, kasa_arc"
    ):
        curves.fit_curve(points, tangents, 'spline')
    with pytest.raises(ValueError, match='expected points and tangents'):
        curves.fit_curve(points, tangents[:3])
    with pytest.raises(ValueError, match='exactly 4 points'):
        curves.fit_curve(points[:3], tangents[:3], 'cubic_bezier')
    with pytest.raises(ValueError, match='coincide'):
        curves.kasa_circle(np.ones((4, 2)))
