"""Statics of a rod with tendons: against closed forms, an independent solver, and by hand."""

from continuum_loc import lie
from continuum_loc.mechanics.statics import (
    assemble,
    equilibrium,
    Load,
    new_balance,
    no_load,
    no_tendons,
    paths,
    Rod,
    slide,
    Tendons,
)
import numpy as np
import pytest
from studies.support.cosserat import cosserat_shape, elastica_tip

EI, GJ, LENGTH = 0.3, 0.25, 1.0
ARM = 0.01  # of a tendon


def rod_of(elements: int, EA: float = np.inf, friction=(0.0, 0.0)) -> Rod:
    return Rod(
        np.full(elements, LENGTH / elements),
        np.tile([EA, GJ, EI, EI], (elements, 1)),
        np.zeros((elements, 4)),
        np.tile(np.asarray(friction, float), (elements, 1)),
    )


def tip_load(elements: int, force=(0, 0, 0), moment=(0, 0, 0), weight=(0, 0, 0)) -> Load:
    load = no_load(elements)
    load.force[-1], load.moment[-1], load.weight[:] = force, moment, weight
    return load


def solve(rod: Rod, tendons, load: Load, q=None, memory=None):
    balance = new_balance(len(rod.spans), len(tendons.stiffness))
    balance.T[0] = np.eye(4)
    q = rod.rest.copy() if q is None else q
    memory = np.zeros((len(rod.spans), 2)) if memory is None else memory
    assert equilibrium(rod, tendons, load, memory, q, balance)
    return q, balance


def tendon(elements: int, angle: float, end: float = LENGTH, **values: float) -> Tendons:
    route = paths(
        np.full(elements, LENGTH / elements), np.array([end]), np.array([angle]), np.array([ARM])
    )
    given = {'stiffness': 0.0, 'taken': 0.0, 'tension': 0.0} | values
    return Tendons(route, *(np.array([given[name]]) for name in ('stiffness', 'taken', 'tension')))


def test_a_force_across_the_end_bends_the_rod_into_the_elastica():
    x, deflection = elastica_tip(0.6, EI, LENGTH)
    _, balance = solve(rod_of(12), no_tendons(12), tip_load(12, force=(0.0, 0.0, -0.6)))
    assert np.allclose(balance.T[-1, :3, 3], [x, 0.0, -deflection], atol=5e-6)


@pytest.mark.parametrize(
    'case',
    [
        {'tip_force': (0.3, -0.4, -0.5)},
        {'weight': 0.8},
        {'tip_moment': (0.2, 0.3, -0.5)},
        {'weight': 0.5, 'tip_force': (0.2, 0.3, 0.1), 'tip_moment': (0.1, 0.2, -0.1)},
    ],
)
def test_twelve_elements_agree_with_the_shooting_solver_to_a_fifth_of_a_millimetre(case):
    wanted = cosserat_shape(np.array([0.0, 0.5, 1.0]), LENGTH, EI, GJ, **case)
    load = tip_load(
        12,
        case.get('tip_force', (0, 0, 0)),
        case.get('tip_moment', (0, 0, 0)),
        (0.0, 0.0, -case.get('weight', 0.0)),
    )
    _, balance = solve(rod_of(12), no_tendons(12), load)
    assert np.linalg.norm(wanted[2, :3, 3] - [LENGTH, 0.0, 0.0]) > 0.2
    assert np.linalg.norm(balance.T[[6, 12], :3, 3] - wanted[1:, :3, 3], axis=1).max() < 2e-4


def test_an_extensible_rod_that_hangs_stretches_by_half_its_weight():
    # Stretch at s is w (L - s) / EA, so the tip moves by w L^2 / 2 EA.
    _, balance = solve(rod_of(10, EA=200.0), no_tendons(10), tip_load(10, weight=(4.0, 0.0, 0.0)))
    assert balance.T[-1, 0, 3] == pytest.approx(LENGTH + 4.0 / 400.0, abs=1e-9)


def _energy(rod: Rod, tendons: Tendons, load: Load, q: np.ndarray) -> float:
    """Potential energy without moments, weight lumped at the elements' ends."""
    own = np.sum(rod.spans[:, None] * np.where(np.isinf(rod.stiffness), 0.0, rod.stiffness) * q**2)
    T, work = np.eye(4), 0.0
    for i, h in enumerate(rod.spans):
        T = T @ lie.exp(h * np.array([1.0 + q[i, 0], 0.0, 0.0, *q[i, 1:]]))
        work += load.force[i + 1] @ T[:3, 3]
    stretch = np.maximum(tendons.taken + np.einsum('mij,ij->m', tendons.path, q), 0.0)
    return 0.5 * own - work + 0.5 * tendons.stiffness @ stretch**2


def test_the_residual_is_the_slope_of_the_energy_and_the_tangent_its_own():
    rng = np.random.default_rng(4)
    rod = rod_of(5, EA=300.0)
    # Spread over elements so short that the change of bending along one does not show.
    rod = rod._replace(spans=np.full(5, 0.01))
    route = paths(rod.spans, np.array([0.05, 0.03]), np.array([0.3, 2.0]), np.array([ARM, ARM]))
    tendons = Tendons(route, np.full(2, 900.0), np.array([0.01, 0.02]), np.zeros(2))
    load = no_load(5)
    load.force[1:] = rng.normal(0.0, 2.0, (5, 3))
    q, balance = rng.normal(0.0, 0.5, (5, 4)) * [0.1, 1, 1, 1], new_balance(5, 2)
    balance.T[0] = np.eye(4)
    memory = np.zeros((5, 2))
    assemble(rod, tendons, load, memory, q, balance)
    residual, tangent = balance.residual.copy(), balance.tangent.copy()
    assert np.allclose(tangent, tangent.T)
    step = 1e-5
    for a in range(20):
        moved = np.zeros(20)
        moved[a] = step
        ahead, behind = q + moved.reshape(5, 4), q - moved.reshape(5, 4)
        slope = (_energy(rod, tendons, load, ahead) - _energy(rod, tendons, load, behind)) / (
            2.0 * step
        )
        assert residual[a] == pytest.approx(slope, abs=2e-5 * np.abs(residual).max())
        assemble(rod, tendons, load, memory, ahead, balance)
        up = balance.residual.copy()
        assemble(rod, tendons, load, memory, behind, balance)
        column = (up - balance.residual) / (2.0 * step)
        assert np.allclose(column, tangent[:, a], atol=2e-3 * np.abs(np.diag(tangent)).max())


def test_a_tension_bends_towards_its_tendon_by_moment_over_stiffness():
    # On the side of +y a pull of F makes the moment F r about z: curvature F r / EI.
    q, balance = solve(rod_of(4), tendon(4, 0.0, tension=6.0), no_load(4))
    assert np.allclose(q, [0.0, 0.0, 0.0, 6.0 * ARM / EI])
    assert balance.T[-1, 1, 3] > 0.05


def test_a_displaced_tendon_shares_its_way_between_bending_and_stretch():
    # Least EI L k^2 / 2 + c (d - r L k)^2 / 2 is at k = c r d / (EI + c r^2 L).
    c, d = 2e4, 0.003
    q, balance = solve(rod_of(4), tendon(4, np.pi / 2, stiffness=c, taken=d), no_load(4))
    bend = c * ARM * d / (EI + c * ARM**2 * LENGTH)
    # Going slack softly over 0.02 mm, it pulls c (0.02 mm)^2 / 4 x = 5 mN more at x = 0.39 mm.
    assert np.allclose(q, [0.0, 0.0, -bend, 0.0], rtol=1e-4, atol=1e-12)
    assert balance.pull[0] == pytest.approx(c * (d - ARM * LENGTH * bend), abs=0.006)


def test_a_slack_tendon_pulls_nothing_and_one_that_ends_halfway_bends_half():
    q, balance = solve(rod_of(4), tendon(4, 0.0, stiffness=2e4, taken=-0.002), no_load(4))
    assert np.abs(q).max() < 1e-4 and balance.pull[0] < 2e-3
    q, _ = solve(rod_of(4), tendon(4, 0.0, end=0.5, tension=6.0), no_load(4))
    assert np.allclose(q[:, 3], [6.0 * ARM / EI] * 2 + [0.0] * 2)


def test_friction_keeps_a_share_of_the_bend_after_the_tendon_is_let_go():
    # Pulled to k1, friction slid to m = k1 - limit / f; let go, EI k + f (k - m) = 0.
    f, limit, F = 0.2, 0.02, 9.0
    rod, memory, q = rod_of(3, friction=(f, limit)), np.zeros((3, 2)), np.zeros((3, 4))
    q, _ = solve(rod, tendon(3, 0.0, tension=F), no_load(3), q, memory)
    k1 = (F * ARM - limit) / EI
    assert np.allclose(q[:, 3], k1)
    slide(rod, q, memory)
    q, _ = solve(rod, tendon(3, 0.0), no_load(3), q, memory)
    assert np.allclose(q[:, 3], f * (k1 - limit / f) / (EI + f))


def test_a_load_within_friction_leaves_nothing():
    rod, memory, q = rod_of(3, friction=(0.2, 0.02)), np.zeros((3, 2)), np.zeros((3, 4))
    q, _ = solve(rod, tendon(3, 0.0, tension=3.0), no_load(3), q, memory)
    slide(rod, q, memory)
    assert np.allclose(q[:, 3], 3.0 * ARM / (EI + 0.2)) and not memory.any()
