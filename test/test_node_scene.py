"""What the estimator node makes of ToF frames: points with sigma and anomaly (eqs. 10-12)."""

from dataclasses import replace

from continuum_loc.estimate import Estimate
from continuum_loc.mapping.map_files import load_map
from continuum_loc.nodes.support.memory import SeenScene
from continuum_loc.scene.anomalies import AnomalySettings
from node_graph import BOX, BoxRobot
import numpy as np
import pytest

SECOND = 10**9
TICK = SECOND // 15
TAU = AnomalySettings().tau
POSITION, ROTATION = 0.003, 0.01  # m, rad: standard deviation of each pose's axes


@pytest.fixture(scope='module')
def box(tmp_path_factory):
    return BoxRobot(tmp_path_factory.mktemp('box'))


@pytest.fixture(scope='module')
def prior(box):
    return load_map(box.map)


def poses(box, stamp, shift=(0.0, 0.0, 0.0), status='tracking'):
    """Smoothed poses of the resting robot, moved by `shift`."""
    T = box.T_map_ring.copy()
    T[:, :3, 3] += shift
    covariance = np.tile(np.diag([POSITION**2] * 3 + [ROTATION**2] * 3), (3, 1, 1))
    nothing = np.zeros((3, 6))
    return Estimate(
        stamp, T, covariance, nothing, nothing, covariance, np.zeros(0), T, status, 1.0
    )


def seen(box, prior, stamps, change=lambda frame: frame, duration=3.0):
    """Make a scene that saw every sensor's frame at `stamps` and placed all of them."""
    scene = SeenScene(box.robot, prior, duration)
    for stamp in stamps:
        for sensor in box.robot.tof:
            scene.see(change(box.frame(sensor, stamp)))
        scene.follow(poses(box, stamp))
    while scene.work():
        pass
    return scene


def test_points_lie_on_the_walls_and_their_sigma_is_of_beam_and_pose(box, prior):
    """By eq. 11 the trace of a point's covariance is sigma_r^2 + 3 sigma_p^2 + 2 r^2 sigma_w^2."""
    record = seen(box, prior, [SECOND]).record()
    wall = np.abs(record.points[:, :, None] - BOX.T[None]).min(axis=(1, 2))
    assert len(record.points) == 3 * 64 and wall.max() < 0.003
    assert record.stamp == SECOND
    pairs = [(sensor, box.frame(sensor, SECOND)) for sensor in box.robot.tof]
    arm2 = np.concatenate(
        [
            np.sum(
                (f.points @ s.mount.T_ring_sensor[:3, :3].T + s.mount.T_ring_sensor[:3, 3]) ** 2, 1
            )
            for s, f in pairs
        ]
    )
    beam = np.concatenate([frame.sigma for _, frame in pairs])
    floor = 0.001
    expected = np.sqrt((beam**2 + 3 * (POSITION**2 + floor**2) + 2 * ROTATION**2 * arm2) / 3.0)
    np.testing.assert_allclose(record.fields['sigma'], expected, rtol=0.02)


def test_what_fits_the_map_is_no_anomaly_and_what_stands_before_the_wall_is(box, prior):
    """Half of every frame is 8 cm short of the wall: that half stands out, and nothing else."""

    def with_thing(frame):
        short = frame.ranges - 0.08 * (np.arange(64) < 32)
        share = (short / frame.ranges)[:, None]
        return replace(frame, ranges=short, points=frame.points * share)

    record = seen(box, prior, [SECOND + k * TICK for k in range(8)], with_thing).record()
    new = record.fields['anomaly'] ** 2 > TAU
    thing = np.tile(np.arange(64) < 32, len(new) // 64)
    assert new[thing].mean() > 0.95 and new[~thing].mean() < 0.01


def test_a_frame_waits_for_the_smoothed_poses_on_either_side_and_is_placed_between_them(
    box, prior
):
    scene = SeenScene(box.robot, prior, 3.0)
    scene.follow(poses(box, SECOND))
    frame = box.frame(box.robot.sensor('up'), SECOND + TICK // 4)
    scene.see(frame)
    assert not scene.work()
    scene.follow(poses(box, SECOND + TICK, shift=(0.04, 0.0, 0.0)))
    assert scene.work() and not scene.work()
    T = box.T_map_ring[2] @ box.robot.sensor('up').mount.T_ring_sensor
    expected = frame.points @ T[:3, :3].T + T[:3, 3] + [0.01, 0.0, 0.0]
    np.testing.assert_allclose(scene.record().points, expected, atol=1e-6)


def test_what_cannot_be_placed_is_counted(box, prior):
    scene = SeenScene(box.robot, prior, 1.0)
    up = box.robot.sensor('up')
    scene.see(box.frame(up, SECOND))  # before any poses
    scene.follow(poses(box, 2 * SECOND))
    assert scene.skipped == 1
    scene.see(box.frame(up, 2 * SECOND + 1))
    scene.follow(poses(box, 2 * SECOND + TICK, status='lost'))
    assert scene.skipped == 2 and not scene.work()


def test_memory_is_bounded_while_there_is_no_leisure(box, prior):
    """What waits for longer than the scene lasts is given up, and so is what was placed before."""
    scene = seen(box, prior, [SECOND], duration=0.5)
    stamps = range(2 * SECOND, 5 * SECOND, TICK)
    for stamp in stamps:
        for sensor in box.robot.tof:
            scene.see(box.frame(sensor, stamp))
        scene.follow(poses(box, stamp))
    assert scene.skipped == 3 * (len(stamps) - 8)
    placed = 0
    while scene.work():
        placed += 1
    assert placed == 8 and len(scene.record().points) == 8 * 3 * 64


def test_without_a_map_there_is_no_anomaly_to_speak_of(box, tmp_path):
    scene = seen(box, None, [SECOND])
    assert np.isnan(scene.record().fields['anomaly']).all()
    scene.save(tmp_path / 'scene.ply')
    assert len(load_map(tmp_path / 'scene.ply').points) == 3 * 64


def test_a_saved_scene_serves_as_a_map(box, prior, tmp_path):
    scene = seen(box, prior, [SECOND])
    scene.save(tmp_path / 'scene.ply')
    np.testing.assert_allclose(
        load_map(tmp_path / 'scene.ply').points, scene.record().points, atol=1e-6
    )
    with pytest.raises(ValueError, match='nothing was reconstructed'):
        SeenScene(box.robot, prior, 3.0).save(tmp_path / 'none.ply')


def test_an_empty_scene_is_an_empty_cloud(box, prior):
    record = SeenScene(box.robot, prior, 3.0).record()
    assert record.stamp == 0 and all(len(column) == 0 for column in record.fields.values())
