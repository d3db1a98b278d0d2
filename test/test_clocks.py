"""What residuals say of clocks, by hand: one unknown offset in a least squares that is solved."""

from continuum_loc.estimator.clocks import ClockEvidence, ClockOffset
import numpy as np
import pytest

LEAST, SIGMAS = 0.025, 5.0


def evidence(gradient, own, taken, spread=None) -> ClockEvidence:
    """Gather what sensors a, b, c ... say: slopes, information, and what the body takes of it."""
    count = len(gradient)
    gradient, own = np.array(gradient, float), np.array(own, float)
    taken = np.array(taken, float).reshape(count, count)
    return ClockEvidence(
        list('abcdef'[:count]),
        gradient,
        np.diag(own) - taken,
        np.column_stack([gradient, own]),
        taken,
        np.ones(count) if spread is None else np.array(spread, float),
    )


def test_an_offset_is_the_slope_over_the_information_that_is_left():
    """50,000 of its own less 10,000 that the body explains: a slope of 1,600 is -40 +- 5 ms."""
    told = evidence([1600.0], [5e4], [1e4]).offsets([('a',)], LEAST, SIGMAS)
    assert [one.sensors for one in told] == [('a',)]
    assert told[0].offset == pytest.approx(-0.04)
    assert told[0].sigma == pytest.approx(0.005)
    assert told[0].sigmas == pytest.approx(8.0)


@pytest.mark.parametrize(
    ('slope', 'own', 'told'),
    [
        (-1000.0, 4e4, True),  # 25 +- 5 ms: as late as is told, as sure as is asked
        (-960.0, 4e4, False),  # 24 ms
        (-750.0, 2.5e4, False),  # 30 ms, of which 6.3 are a sigma: 4.7 of them
        (-8000.0, 4e4, True),  # 0.2 s: the most that the first order describes
        (-8400.0, 4e4, False),
        (-0.9, 0.9, False),  # hardly any information
    ],
)
def test_only_offsets_that_are_large_and_sure_are_told(slope, own, told):
    found = evidence([slope], [own], [0.0]).offsets([('a',)], LEAST, SIGMAS)
    assert bool(found) is told


def test_what_a_wrong_clock_drags_along_is_not_blamed():
    """
    The late sensor a pulls the body, so that b seems early by half of it.

    a: 60 ms; b, coupled to it by half of its information, has a slope of -0.5 * 60 ms of it.
    Once a's offset is taken out nothing is left of b's.
    """
    late, information = 0.06, 4e4
    coupling = -0.5 * information  # taken from between them: information is own less taken
    full = np.array([[information, coupling], [coupling, information]])
    gradient = -full @ [late, 0.0]
    taken = np.diag([information] * 2) - full
    found = evidence(gradient, [information] * 2, taken).offsets([('a',), ('b',)], LEAST, SIGMAS)
    assert [one.sensors for one in found] == [('a',)]
    assert found[0].offset == pytest.approx(late)


def test_two_wrong_clocks_are_both_found_through_their_coupling():
    full = np.array([[4e4, -1e4], [-1e4, 4e4]])
    taken = np.diag([4e4, 4e4]) - full
    gradient = -full @ [0.08, -0.05]
    found = evidence(gradient, [4e4, 4e4], taken).offsets([('a',), ('b',)], LEAST, SIGMAS)
    offsets = {one.sensors: one.offset for one in found}
    # The first is taken as if it were alone, so that the other's share is still in it.
    assert offsets[('a',)] == pytest.approx(0.08 + 0.05 / 4.0)
    assert set(offsets) == {('a',), ('b',)}
    assert offsets[('b',)] == pytest.approx(-0.05, abs=0.01)


def test_sensors_of_one_clock_are_counted_together():
    """30 ms at 2.7 sigmas each are 4.7 of them for three sensors, and 5.4 for four."""
    alone = evidence([-240.0] * 4, [8e3] * 4, np.zeros((4, 4)))
    assert alone.offsets([('a',), ('b',)], LEAST, SIGMAS) == []
    assert alone.offsets([('a', 'b', 'c')], LEAST, SIGMAS) == []
    together = alone.offsets([('a', 'b', 'c', 'd')], LEAST, SIGMAS)
    assert together[0].offset == pytest.approx(0.03)
    assert together[0].sigma == pytest.approx((4 * 8e3) ** -0.5)


def test_residuals_larger_than_their_noise_widen_what_is_told():
    """A variance nine times the noise's makes 12 sigmas 4, which is not sure enough; 18 are 6."""
    own = 4e4
    for offset, told in ((0.06, False), (0.09, True)):
        found = evidence([-offset * own], [own], [0.0], [9.0]).offsets([('a',)], LEAST, SIGMAS)
        assert bool(found) is told
        if told:
            assert found[0].sigma == pytest.approx(0.015)
    calm = evidence([-0.03 * own], [own], [0.0], [0.1]).offsets([('a',)], LEAST, SIGMAS)
    assert calm[0].sigma == pytest.approx(0.005)  # never narrower than the noise says


def test_a_sensor_that_counts_little_is_judged_at_full_weight():
    """
    At a weight of 0.05 slope and information are a twentieth of what they would be.

    Own 2,000 is 40,000; the body's part, which goes with the weight twice, 150 is 60,000. The
    body does not follow the sensor, so that its uncertainty adds: sqrt(100,000) / 40,000.
    """
    found = evidence([-2000.0], [4e4], [150.0]).outside(('a',), 0.05)
    assert found.offset == pytest.approx(0.05)
    assert found.sigma == pytest.approx(np.sqrt(1e5) / 4e4)
    two = evidence([-2000.0, -1200.0], [4e4, 4e4], [[150.0, 20.0], [20.0, 150.0]])
    both = two.outside(('a', 'b'), 0.05)
    assert both.offset == pytest.approx(160.0 / 4000.0)
    assert both.sigma == pytest.approx(np.sqrt(8e4 + 340.0 * 400.0) / 8e4)


def test_without_information_there_is_no_offset():
    nothing = evidence([-1.0], [0.04], [0.0])
    assert nothing.outside(('a',), 0.05) == ClockOffset(('a',), 0.0, np.inf)
    assert nothing.outside(('a',), 0.05).sigmas == 0.0
