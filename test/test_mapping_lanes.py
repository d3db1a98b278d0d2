"""Sixteen points at a time give what numpy gives, and no error is larger than said."""

from continuum_loc.mapping.lanes import (
    ALL_LANES,
    COS_ERROR,
    facing_lanes,
    FAR,
    LANES,
    lowest_lane,
    near_lanes,
    nearest_lane2,
    pack_lanes,
    rival_lanes,
    SINGLE,
    slack2,
    two_nearest,
    two_nearest_facing,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
import numpy as np
import pytest


@njit
def near(lanes, group, place, limit2):
    return near_lanes(lanes, group, place[0], place[1], place[2], limit2)


@njit
def facing(faces, group, beam, min_cos):
    return facing_lanes(faces, group, beam[0], beam[1], beam[2], min_cos)


@njit
def nearest(lanes, group, chosen, place):
    return nearest_lane2(lanes, group, chosen, place[0], place[1], place[2])


@njit
def rivals(lanes, group, centre, other, edge, limit2):
    return rival_lanes(
        lanes, group, centre[0], centre[1], centre[2], other[0], other[1], other[2], edge, limit2
    )


@njit
def two_of(lanes, groups, first, after, place):
    return two_nearest(lanes, groups, first, after, place[0], place[1], place[2])


@njit
def two_facing(lanes, groups, first, after, place, faces, beam, min_cos):
    return two_nearest_facing(
        lanes, groups, first, after, place[0], place[1], place[2],
        faces, beam[0], beam[1], beam[2], min_cos,
    )  # fmt: skip


@njit
def lowest(chosen):
    return lowest_lane(chosen)


def bits(holds):
    return sum(int(one) << lane for lane, one in enumerate(holds))


def cloud(seed, count=70):
    """Whole numbers, with which single precision makes no error, and as many directions."""
    rng = np.random.default_rng(seed)
    directions = rng.integers(-4, 5, (count, 3)) / 4.0
    return rng.integers(-20, 20, (count, 3)).astype(np.float32), directions.astype(np.float32), rng


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 3), st.integers(0, ALL_LANES))
def test_each_agrees_with_numpy(seed, group, chosen):
    points, normals, rng = cloud(seed)
    lanes, faces = pack_lanes(points, FAR), pack_lanes(normals, np.nan)
    own = slice(LANES * group, LANES * (group + 1))
    place, beam = points[rng.integers(len(points))] + np.float32(0.5), normals[0]
    distance2 = np.sum((points[own] - place) ** 2, axis=1)
    assert near(lanes, group, place, np.float32(300.0)) == bits(distance2 <= 300.0)
    assert facing(faces, group, beam, np.float32(0.25)) == bits(-normals[own] @ beam >= 0.25)
    kept = distance2[[chosen >> lane & 1 == 1 for lane in range(LANES)]]
    assert nearest(lanes, group, chosen, place) == kept.min(initial=np.inf)
    other = points[5]
    swing = np.float32(3.0) * np.abs(points[own] - other).sum(axis=1)
    own2 = np.sum((other - place) ** 2)
    expected = bits(distance2 - swing <= own2)
    assert rivals(lanes, group, place, other, np.float32(3.0), own2) == expected


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.lists(st.integers(0, 4), max_size=5, unique=True))
def test_the_two_nearest_of_a_list_and_of_those_that_face(seed, listed):
    points, normals, rng = cloud(seed)
    lanes, faces = pack_lanes(points, FAR), pack_lanes(normals, np.nan)
    place, beam = points[rng.integers(len(points))] + np.float32(0.5), normals[0]
    filled = np.concatenate([points, np.full((5 * LANES - len(points), 3), FAR)])
    distance2 = np.sum((filled - place) ** 2, axis=1).reshape(5, LANES)
    may = np.zeros((5, LANES), bool)
    may.reshape(-1)[: len(points)] = -normals @ beam >= 0.25
    groups = np.array(listed, np.int32)
    answers = (
        (distance2, two_of(lanes, groups, 0, len(groups), place)),
        (
            np.where(may, distance2, np.inf),
            two_facing(lanes, groups, 0, len(groups), place, faces, beam, np.float32(0.25)),
        ),
    )
    for found2, (point, least2, next2) in answers:
        ordered = np.append(np.sort(found2[listed].ravel()), [np.inf, np.inf])
        np.testing.assert_allclose([least2, next2], ordered[:2], rtol=1e-6)
        if least2 < np.inf:
            assert point // LANES in listed and found2.reshape(-1)[point] == pytest.approx(least2)


def test_groups_that_follow_one_another_need_no_names():
    points, _, _ = cloud(3)
    lanes = pack_lanes(points, FAR)
    place = points[40] + np.float32(0.25)
    named = two_of(lanes, np.arange(1, 4, dtype=np.int32), 0, 3, place)
    assert two_of(lanes, None, 1, 4, place) == named


@pytest.mark.parametrize('chosen', [1, 2, 0b1010000, 1 << 15, ALL_LANES])
def test_the_lowest_of_the_chosen(chosen):
    assert lowest(chosen) == bin(chosen)[::-1].index('1')


@settings(max_examples=100, deadline=None)
@given(
    st.integers(0, 10**6),
    st.floats(1e-3, 1e4),
    st.floats(-7.0, 0.0),
)
def test_single_precision_errs_by_no_more_than_said(seed, extent, nearness):
    """Of a cloud this far across [m], for places as near to a point as a share of that."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, extent, (LANES, 3))
    place = points[0] + extent * 10.0**nearness * rng.normal(size=3) / 3.0
    lanes, rounding = pack_lanes(points, FAR), 4.0 * SINGLE * 2.0 * extent
    for lane in range(LANES):
        found2 = float(nearest(lanes, 0, 1 << lane, place.astype(np.float32)))
        true2 = np.sum((points[lane] - place) ** 2)
        assert abs(found2 - true2) <= min(slack2(true2, rounding), slack2(found2, rounding))
    normals = rng.normal(size=(LANES, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces, cosines = pack_lanes(normals, np.nan), normals @ normals[0]
    for lane in range(1, LANES):
        for off, faced in ((-COS_ERROR, True), (COS_ERROR, False)):
            chosen = facing(
                faces, 0, -normals[0].astype(np.float32), np.float32(cosines[lane] + off)
            )
            assert (chosen >> lane & 1 == 1) == faced
