"""Recorded trials: their import, and the filter on them (where CONTINUUM_LOC_DATA is set)."""

import os

from continuum_loc import lie
from continuum_loc.errors import BagError
from continuum_loc.measurements import ImuSample, TrackedPose, TruthSample
from continuum_loc.robot import load_robot
from hypothesis import given
from hypothesis import strategies as st
from msg_tools.bag import read_bag
import numpy as np
import pytest
from studies.support.tendon_robot import (
    import_trial,
    measured_anew,
    R_THEIRS_OURS,
    read_recording,
    STAMP_OF_ZERO,
    T_THEIRS_OURS,
)

needs_data = pytest.mark.skipif(
    not os.environ.get('CONTINUUM_LOC_DATA'),
    reason='CONTINUUM_LOC_DATA, the folder of the recorded trials, is unset',
)
ROBOT = load_robot('tendon_robot')
DISCS = (0.0, 0.1165, 0.233, 0.3495, 0.466)


def _write(path, kind, s, rows):
    lines = [f'sensor type:,{kind}', 'timestamp (s),arclength (m),data']
    path.write_text(
        '\n'.join(lines + [','.join(repr(float(x)) for x in (t, s, *data)) for t, data in rows])
        + '\n'
    )


@pytest.fixture
def trial(tmp_path):
    """Write a straight robot that turns about the map's z at 0.5 rad/s, in the files' frames."""
    folder = tmp_path / 'trial'
    folder.mkdir()
    times = np.arange(-0.04, 1.0, 0.02)

    def pose(t, s):
        return lie.log(
            np.block(
                [
                    [lie.so3_exp(np.array([0, 0, 0.5 * t])), np.array([[0], [0], [s]])],
                    [np.zeros((1, 3)), np.ones((1, 1))],
                ]
            )
        )

    for number, s in enumerate((0.0, 0.466)):
        _write(folder / f'aurora{number}.csv', 'aurora', s, [(t, pose(t, s)) for t in times])
    for name, s in (('mid', 0.233), ('ee', 0.466)):
        _write(folder / f'gyro_{name}.csv', 'gyro', s, [(t, (0.0, 0.0, 0.5)) for t in times])
    for number, s in enumerate(DISCS):
        _write(folder / f'vicon{number}.csv', 'vicon', s, [(t, pose(t, s)) for t in times[2::3]])
    return folder


def test_the_tangent_becomes_body_x_and_motion_keeps_its_meaning(trial):
    """The imported rates turn the imported poses: dT/dt = T hat(omega), about the tangent."""
    recording = read_recording(trial, ROBOT)
    tip = [
        sample
        for sample in recording.measurements
        if isinstance(sample, TrackedPose) and sample.sensor == 'tip_tracker'
    ]
    rate = next(sample for sample in recording.measurements if isinstance(sample, ImuSample))
    np.testing.assert_allclose(tip[0].T_map_sensor[:3, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rate.angular_velocity, [0.5, 0, 0], atol=1e-12)
    turned = lie.log(lie.inverse(tip[0].T_map_sensor) @ tip[10].T_map_sensor)[3:]
    np.testing.assert_allclose(
        turned, rate.angular_velocity * (tip[10].stamp - tip[0].stamp) * 1e-9, atol=1e-9
    )
    np.testing.assert_allclose(recording.truth['disc2'][1][0][:3, 3], [0, 0, 0.233], atol=1e-12)


def test_the_axes_are_renamed_by_a_rotation():
    np.testing.assert_array_equal(R_THEIRS_OURS @ R_THEIRS_OURS.T, np.eye(3))
    assert np.linalg.det(R_THEIRS_OURS) == pytest.approx(1.0)
    np.testing.assert_array_equal(T_THEIRS_OURS[:3, :3] @ [1, 0, 0], [0, 0, 1])


@given(
    st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6),
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
)
def test_renaming_commutes_with_moving(xi, omega):
    """T Exp(w) renamed equals T renamed, moved by the renamed w, for any pose and rate."""
    T, w = lie.exp(0.5 * np.array(xi)), np.concatenate([np.zeros(3), omega])
    renamed = np.concatenate([np.zeros(3), np.array(omega) @ R_THEIRS_OURS])
    np.testing.assert_allclose(
        T @ lie.exp(w) @ T_THEIRS_OURS, T @ T_THEIRS_OURS @ lie.exp(renamed), atol=1e-9
    )


def test_a_bag_gives_back_what_was_imported(trial, tmp_path):
    counts = import_trial(trial, tmp_path / 'bag', ROBOT)
    recording = read_recording(trial, ROBOT)
    back = [item for _, item in read_bag(tmp_path / 'bag')]
    assert counts == {
        'tracker/base_tracker': 52,
        'tracker/tip_tracker': 52,
        'imu/data_raw': 104,
        'ground_truth/poses': 17,
    }
    for kind, wanted in (('TrackedPose', TrackedPose), ('ImuSample', ImuSample)):
        ours = [s for s in recording.measurements if isinstance(s, wanted)]
        theirs = [s for s in back if isinstance(s, wanted)]
        assert [(s.stamp, s.sensor) for s in ours] == [(s.stamp, s.sensor) for s in theirs], kind
    rates = [s for s in back if isinstance(s, ImuSample)]
    assert all(np.isnan(s.linear_acceleration).all() for s in rates)
    truth = [s for s in back if isinstance(s, TruthSample)]
    np.testing.assert_allclose(truth[0].T_map_ring[:, 2, 3], [0.0, *DISCS], atol=1e-9)
    assert min(s.stamp for s in back) == STAMP_OF_ZERO - 40_000_000


@pytest.mark.parametrize(
    ('line', 'replaced', 'said'),
    [
        (0, 'sensor type:,sonar', 'one of aurora, vicon, gyro'),
        (5, '0.1,0.0,1,2,3', 'expected 8 numbers'),
        (5, '0.1,0.0,1,2,3,4,5,x', 'line 6'),
        (5, '0.1,0.0,1,2,3,4,5,nan', 'not finite'),
        (5, '0.1,0.3,1,2,3,4,5,6', 'a file holds one sensor'),
        (5, '-3,0.0,1,2,3,4,5,6', 'increase'),
    ],
)
def test_damaged_files_are_refused_with_their_place(trial, line, replaced, said):
    path = trial / 'aurora0.csv'
    lines = path.read_text().splitlines()
    lines[line] = replaced
    path.write_text('\n'.join(lines))
    with pytest.raises(BagError, match=said) as error:
        read_recording(trial, ROBOT)
    assert 'aurora0.csv' in str(error.value)


def test_what_the_robot_does_not_have_is_named(trial, tmp_path):
    _write(trial / 'gyro_base.csv', 'gyro', 0.05, [(0.0, (0, 0, 0))])
    with pytest.raises(BagError, match=r'no gyro at s = 0.05 m; it has some at: 0.233, 0.466'):
        read_recording(trial, ROBOT)
    with pytest.raises(BagError, match='no .csv files'):
        read_recording(tmp_path / 'nowhere', ROBOT)


@needs_data
def test_hermite_curves_give_the_published_figures():
    """
    The metric is the published one.

    Plain Hermite interpolation has the published RMSE, to its last digit.
    """
    from studies.real import data_folder, HERMITE, hermite_errors, WINDOWS

    for name, window in WINDOWS.items():
        logged = read_recording(data_folder() / name, ROBOT, as_logged=True)
        found = hermite_errors(logged, ROBOT, window)
        rmse = [1e3 * np.sqrt(np.mean(error**2)) for error in found.values()]
        np.testing.assert_allclose(rmse, HERMITE[name], atol=0.051)


@needs_data
def test_the_smoothed_filter_beats_hermite_and_the_published_filter_inside_the_body(tmp_path):
    """Gyros and bending help the three discs without a tracker, through impulses, 0.1 s late."""
    from studies.real import run

    inner = [
        claim
        for claim in run(tmp_path, True, 0, 1)
        if 'lag' in claim.name and 'disc4' not in claim.name
    ]
    assert len(inner) == 6
    assert all(claim.holds for claim in inner), [claim for claim in inner if not claim.holds]


def test_held_rows_are_dropped_and_stamps_evened_out():
    """Of 40 Hz logged on a 50 Hz grid each sample stays once, as late as all others."""
    grid = np.round(0.02 * np.arange(500) * 1e9).astype(np.int64)
    sample = np.floor(grid * 1e-9 / 0.025 + 1e-6).astype(int)
    values = np.random.default_rng(1).normal(size=(sample[-1] + 1, 6))
    stamps, fresh = measured_anew(grid, values[sample]).values()
    np.testing.assert_array_equal(fresh, values)
    late = stamps * 1e-9 - 0.025 * np.arange(len(values))
    assert np.ptp(late[8:-8]) < 1e-3  # the grid's own stamps differ by 15 ms
    assert 0.0 <= late.mean() <= 0.02


def test_a_log_without_held_rows_keeps_its_stamps():
    grid = np.cumsum(np.random.default_rng(2).integers(15_000_000, 25_000_000, 100))
    values = np.random.default_rng(3).normal(size=(100, 6))
    stamps, fresh = measured_anew(grid, values).values()
    np.testing.assert_array_equal(stamps, grid)
    np.testing.assert_array_equal(fresh, values)
