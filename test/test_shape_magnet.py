"""The magnet's field, against closed forms and direct integration, and its inverse problem."""

from continuum_loc import lie
from continuum_loc.magnet import (
    dipole_moment,
    field_and_gradient,
    field_error,
    field_residual_and_jacobian,
    invert_dipole,
    magnet_parameters,
    ring_field,
)
from continuum_loc.robot import load_robot, Magnet
from continuum_loc.shape.position import PositionSolver
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import Bounds, least_squares, minimize

MAGNET = load_robot('hall_arm').magnet
ARCLENGTHS = np.array([0.025, 0.050, 0.075])

distances = st.floats(0.02, 0.1)
# Off the equatorial plane, on the magnet's positive side.
polar = st.floats(0.0, 1.5)
azimuths = st.floats(-3.14, 3.14)


def spherical(distance, angle, azimuth):
    return distance * np.array(
        [np.cos(angle), np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth)]
    )


def dipole_field(magnet, p):
    """(..., 3) the textbook's point dipole (eq. 2), in vectors."""
    moment = dipole_moment(magnet) * np.array([1.0, 0.0, 0.0])
    r = np.linalg.norm(p, axis=-1, keepdims=True)
    return 1e-7 * (3.0 * p * (p @ moment)[..., None] / r**5 - moment / r**3)


def test_ring_on_axis_is_the_textbook_formula():
    x = np.linspace(0.01, 0.2, 30)

    def disc_pair(radius):
        ends = x[:, None] + MAGNET.length / 2 * np.array([1.0, -1.0])
        ratio = ends / np.hypot(ends, radius)
        return ratio[:, 0] - ratio[:, 1]

    expected = (
        MAGNET.remanence
        / 2
        * (disc_pair(MAGNET.outer_diameter / 2) - disc_pair(MAGNET.inner_diameter / 2))
    )
    got = ring_field(MAGNET, np.column_stack([x, 0 * x, 0 * x]))
    np.testing.assert_allclose(got[:, 0], expected, rtol=1e-11)
    np.testing.assert_allclose(got[:, 1:], 0.0, atol=1e-18)


@pytest.mark.parametrize(
    'p', [(0.02, 0.015, 0.01), (0.01, 0.03, -0.02), (-0.03, 0.01, 0.002), (0.0, 0.02, 0.0)]
)
def test_ring_off_axis_is_the_integral_over_its_charged_faces(p):
    nodes, weights = np.polynomial.legendre.leggauss(24)
    inner, outer = MAGNET.inner_diameter / 2, MAGNET.outer_diameter / 2
    r = 0.5 * (outer + inner) + 0.5 * (outer - inner) * nodes
    angle = np.arange(256) / 256 * 2 * np.pi
    R, A = np.meshgrid(r, angle, indexing='ij')
    area = np.broadcast_to(
        (0.5 * (outer - inner) * weights * r)[:, None] * 2 * np.pi / 256, R.shape
    )
    expected = np.zeros(3)
    for sign in (1.0, -1.0):
        away = np.array(p) - np.stack(
            [np.full_like(R, sign * MAGNET.length / 2), R * np.cos(A), R * np.sin(A)], -1
        )
        expected += sign * (
            area[..., None] * away / np.linalg.norm(away, axis=-1, keepdims=True) ** 3
        ).sum((0, 1))
    expected *= MAGNET.remanence / (4 * np.pi)
    np.testing.assert_allclose(ring_field(MAGNET, np.array(p)), expected, rtol=1e-10, atol=1e-15)


def test_ring_tends_to_the_dipole_as_the_square_of_its_size_over_distance():
    directions = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])

    def gap(distance):
        ring, dipole = (
            ring_field(MAGNET, distance * directions),
            dipole_field(MAGNET, distance * directions),
        )
        return np.linalg.norm(ring - dipole, axis=1) / np.linalg.norm(dipole, axis=1)

    np.testing.assert_allclose(gap(0.4) / gap(0.2), 0.25, rtol=0.02)


def test_the_magnet_has_the_moment_of_the_paper():
    """Its volume is pi/4 (14^2 - 10^2) mm^2 * 13 mm = 980.2 mm^3, its remanence 1.0718 T."""
    assert dipole_moment(MAGNET) == pytest.approx(1.0718 * 980.2e-9 / 1.25664e-6, rel=1e-4)
    assert dipole_moment(MAGNET) == pytest.approx(0.836, rel=1e-4)


def test_dipole_on_axis_and_on_the_equator():
    moment = 0.836
    field, _ = field_and_gradient(MAGNET, np.array([[0.05, 0, 0], [0, 0.05, 0]]), 'dipole')
    np.testing.assert_allclose(
        field,
        [[2e-7 * moment / 0.05**3, 0, 0], [-1e-7 * moment / 0.05**3, 0, 0]],
        rtol=1e-4,
        atol=1e-18,
    )


@given(distances, polar, azimuths)
@settings(max_examples=60, deadline=None)
def test_dipole_kernel_is_the_textbooks_dipole(distance, angle, azimuth):
    p = spherical(distance, angle, azimuth)
    found, _ = field_and_gradient(MAGNET, p, 'dipole')
    np.testing.assert_allclose(found, dipole_field(MAGNET, p), rtol=1e-12, atol=1e-18)


def test_the_ring_is_no_dipole_at_the_modules():
    """A dipole reads the distance on the ring's axis wrong: by 0.59, 0.21 and 0.13 mm."""
    p = np.column_stack([ARCLENGTHS, 0 * ARCLENGTHS, 0 * ARCLENGTHS])
    read = invert_dipole(MAGNET, ring_field(MAGNET, p))[:, 0]
    np.testing.assert_allclose((read - ARCLENGTHS) * 1e3, [0.59, 0.21, 0.13], atol=0.006)


@given(distances, polar, azimuths, st.sampled_from(['ring', 'dipole']))
@settings(max_examples=60, deadline=None)
def test_gradient_is_that_of_a_source_free_field(distance, angle, azimuth, model):
    p = spherical(distance, angle, azimuth)
    _, gradient = field_and_gradient(MAGNET, p, model)
    h = 1e-6
    columns = [
        (
            field_and_gradient(MAGNET, p + h * e, model)[0]
            - field_and_gradient(MAGNET, p - h * e, model)[0]
        )
        / (2 * h)
        for e in np.eye(3)
    ]
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(gradient, np.column_stack(columns), atol=1e-6 * scale)
    assert abs(np.trace(gradient)) < 1e-12 * scale
    np.testing.assert_allclose(gradient, gradient.T, atol=1e-12 * scale)


@given(distances, polar, azimuths, st.sampled_from([1.0, -1.0]))
@settings(max_examples=100, deadline=None)
def test_dipole_inverts_in_closed_form(distance, angle, azimuth, sign):
    magnet = MAGNET.model_copy(update={'remanence': sign * MAGNET.remanence})
    p = spherical(distance, angle, azimuth)
    np.testing.assert_allclose(invert_dipole(magnet, dipole_field(magnet, p)), p, atol=1e-12)


def test_opposite_positions_have_one_field():
    p = spherical(0.05, 0.7, 0.3)
    np.testing.assert_allclose(ring_field(MAGNET, -p), ring_field(MAGNET, p), rtol=1e-12)


@given(
    st.lists(
        st.tuples(st.floats(0.8, 1.0), st.floats(0.0, 1.45), azimuths), min_size=3, max_size=3
    ),
    st.sampled_from(['ring', 'dipole']),
)
@settings(max_examples=60, deadline=None)
def test_positions_come_back_from_their_fields(places, model):
    p = np.array(
        [
            spherical(s * share, angle, az)
            for s, (share, angle, az) in zip(ARCLENGTHS, places, strict=True)
        ]
    )
    fit = PositionSolver(MAGNET, ARCLENGTHS, model).solve(field_and_gradient(MAGNET, p, model)[0])
    np.testing.assert_allclose(fit.position, p, atol=1e-9)
    assert fit.converged.all() and not fit.ambiguous.any()


def test_optimum_on_the_bounds_is_the_constrained_one():
    """A field from beyond the module's reach: SciPy ends on the same face of the box."""
    solver = PositionSolver(MAGNET, ARCLENGTHS)
    p = np.array([[0.030, 0.004, 0.0], [0.040, 0.056, 0.0], [0.07, 0.0, 0.02]])
    field = ring_field(MAGNET, p)
    fit = solver.solve(field)
    assert fit.bound.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
    assert fit.converged.all() and not fit.bound[2].any()
    for m in range(3):
        size = np.linalg.norm(field[m])
        scipy = least_squares(
            lambda q, m=m, size=size: (ring_field(MAGNET, q) - field[m]) / size,
            [0.02, 0.001, 0.001],
            bounds=(solver.lower[m], solver.upper[m]),
            x_scale=0.01,
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        np.testing.assert_allclose(fit.position[m], scipy.x, atol=1e-6)


def test_agrees_with_the_interior_point_minimiser():
    rng = np.random.default_rng(3)
    p = np.array([[0.023, 0.007, 0.002], [0.040, 0.025, -0.005], [0.045, 0.05, -0.01]])
    field = ring_field(MAGNET, p) + 1e-6 * rng.standard_normal((3, 3))
    solver = PositionSolver(MAGNET, ARCLENGTHS)
    fit = solver.solve(field)
    for m in range(3):
        size = np.linalg.norm(field[m])

        def cost(q, m=m, size=size):
            b, gradient = field_and_gradient(MAGNET, q / 1e3)
            error = (b - field[m]) / size
            return error @ error, 2 * gradient.T @ error / size / 1e3

        scipy = minimize(
            cost,
            1.05e3 * p[m],
            jac=True,
            method='trust-constr',
            bounds=Bounds(1e3 * solver.lower[m], 1e3 * solver.upper[m]),
            options={'gtol': 1e-12, 'xtol': 1e-12, 'barrier_tol': 1e-12, 'maxiter': 500},
        )
        np.testing.assert_allclose(fit.position[m], scipy.x / 1e3, atol=1e-6)


def test_covariance_is_what_many_noisy_solutions_spread():
    """The variance of 2000 draws has a relative sigma of 3.2 %, so 16 % is beyond 5 sigma."""
    rng = np.random.default_rng(5)
    p = np.array([[0.0234, 0.0076, 0.0], [0.038, 0.0274, 0.0], [0.0382, 0.052, 0.0]])
    solver, sigma, attitude = PositionSolver(MAGNET, ARCLENGTHS), 1e-6, np.radians(0.3)
    field = ring_field(MAGNET, p)
    covariance, observable = solver.covariance(
        p, field, sigma, np.stack([attitude**2 * np.eye(3)] * 3)
    )
    turns = attitude * rng.standard_normal((2000, 3, 3))
    # A rotation error phi of the module turns what it measured.
    noisy = field + np.cross(turns, field) + sigma * rng.standard_normal((2000, 3, 3))
    found = np.stack([solver.solve(b, p).position for b in noisy]) - p
    spread = np.einsum('kmi,kmi->mi', found, found) / len(found)
    np.testing.assert_allclose(
        spread / np.diagonal(covariance, axis1=1, axis2=2)[:, :3], 1.0, atol=0.16
    )
    cross = np.einsum('kmi,kmj->mij', found, turns) / len(found)
    scale = np.sqrt(np.einsum('mi,mj->mij', spread, np.full((3, 3), attitude**2)))
    np.testing.assert_allclose((cross - covariance[:, :3, 3:]) / scale, 0.0, atol=0.12)
    assert observable.all()


def test_equatorial_plane_is_told_as_unobservable():
    solver = PositionSolver(MAGNET, ARCLENGTHS, 'dipole')
    p = np.array([[0.0, 0.024, 0.0], [0.0, 0.049, 0.0], [0.05, 0.03, 0.0]])
    attitude = np.stack([np.radians(0.5) ** 2 * np.eye(3)] * 3)
    field = dipole_field(MAGNET, p)
    singular = np.linalg.svd(field_and_gradient(MAGNET, p, 'dipole')[1])[1]
    assert (singular[:2, 2] < 1e-9 * singular[:2, 0]).all(), 'the gradient has rank 2 there'
    assert solver.covariance(p, field, 1e-6, attitude)[1].tolist() == [False, False, True]


def test_saturated_field_has_no_position():
    field = np.full((3, 3), 1e-3)
    field[0, 0] = np.nan
    with pytest.raises(ValueError, match='finite field'):
        PositionSolver(MAGNET, ARCLENGTHS).solve(field)


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_the_field_seen_by_a_body_differentiates_on_the_right(seed):
    rng = np.random.default_rng(seed)
    T_map_magnet = lie.exp(rng.normal(size=6) * [0.1, 0.1, 0.1, 1, 1, 1])
    T = T_map_magnet @ lie.exp(
        np.concatenate([spherical(0.05, rng.uniform(0, 1.4), 1.0), rng.normal(size=3)])
    )
    earth = rng.normal(size=3) * 3e-5

    def numeric(function, h=1e-6):
        return np.column_stack(
            [
                (function(T @ lie.exp(h * e)) - function(T @ lie.exp(-h * e))) / (2 * h)
                for e in np.eye(6)
            ]
        )

    def field(pose):
        return field_residual_and_jacobian(pose, MAGNET, T_map_magnet, np.zeros(3), earth)

    _, jacobian = field(T)
    np.testing.assert_allclose(
        jacobian, numeric(lambda pose: field(pose)[0]), atol=1e-6 * np.abs(jacobian).max()
    )


def test_the_field_seen_by_a_body_takes_batches():
    rng = np.random.default_rng(0)
    T = lie.exp(rng.normal(size=(4, 2, 6)) * 0.3 + [0.3, 0, 0, 0, 0, 0])
    residual, jacobian = field_residual_and_jacobian(T, MAGNET, np.eye(4), np.zeros((4, 2, 3)))
    single = field_residual_and_jacobian(T[2, 1], MAGNET, np.eye(4), np.zeros(3))
    np.testing.assert_allclose(residual[2, 1], single[0])
    np.testing.assert_allclose(jacobian[2, 1], single[1])


def test_the_compiled_field_seen_by_a_body_is_the_same():
    """`field_error`, for compiled callers, against its twin in NumPy."""
    rng = np.random.default_rng(7)
    T = lie.exp(rng.normal(size=6) * 0.2 + [0.05, 0, 0, 0, 0, 0])
    measured, earth = rng.normal(size=3) * 1e-3, rng.normal(size=3) * 3e-5
    residual, J = np.empty(3), np.empty((3, 6))
    for model in ('ring', 'dipole'):
        field_error(
            magnet_parameters(MAGNET, model), T[:3, :3], T[:3, 3], earth, measured, residual, J
        )
        expected, jacobian = field_residual_and_jacobian(
            T, MAGNET, np.eye(4), measured, earth, model
        )
        np.testing.assert_allclose(residual, expected, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(J, jacobian, rtol=1e-11, atol=1e-14)


def test_unknown_model_names_the_valid_ones():
    with pytest.raises(ValueError, match='valid: ring, dipole'):
        field_and_gradient(Magnet(), np.zeros(3), 'disc')
