"""Identification: a made-up robot is found again from its motors and the positions of its tip."""

from dataclasses import replace

from continuum_loc.actuation import Actuation
from continuum_loc.errors import BagError, CalibrationError
from continuum_loc.mechanics.body import TendonBody
from continuum_loc.mechanics.history import follow, Model
from continuum_loc.offline.find_tendons import alone, broken
from continuum_loc.offline.identified import folds_of, identify, predict, read_recording, rmse
from continuum_loc.offline.identify import Identification
from continuum_loc.offline.motor_csv import read_csv, Recording, samples, together
from continuum_loc.offline.trials import write_bag
from continuum_loc.robot import RobotDescription
import numpy as np
import pytest

ARM, ENDS = 0.005, (0.1, 0.2)
ANGLES = {'m1': 20.0, 'm2': 140.0, 'm3': 260.0, 'm4': 80.0, 'm5': 200.0, 'm6': 320.0}
REVERSED, SLACK = 'm5', 'm2'


def bare() -> RobotDescription:
    return RobotDescription(
        name='made_up',
        length=ENDS[-1],
        radius=0.01,
        base={'rpy_deg': (0.0, -90.0, 0.0)},
        backbone={'module_ends': (ENDS[0],)},
        rings=[{'name': 'tip', 's': ENDS[-1]}],
        trackers=[{'name': 'marker', 'ring': 'tip'}],
    )


def true() -> RobotDescription:
    """Six tendons to two ends, one motor reversed, one tendon slack; friction and offsets."""
    tendons = [
        {
            'name': name,
            'end': ENDS[i // 3],
            'azimuth_deg': angle,
            'radius': ARM * (1.0 + 0.02 * (i - 2)),
            'sign': -1 if name == REVERSED else 1,
            'offset': -0.0018 if name == SLACK else 0.0001 * i,
            'stiffness': 3e6,
        }
        for i, (name, angle) in enumerate(ANGLES.items())
    ]
    block = Actuation(
        tendons=tendons,
        EI=(1.0, 0.7),
        EA=8e4,
        rest=((0.2, -0.1), (0.0, 0.3)),
        friction={'share': 0.25, 'bend': 0.8},
        delay=0.1,
    )
    return bare().model_copy(update={'actuation': block})


def motion(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, motors (S, 6) [m] and patterns: each pulled alone from slack, then two at a time."""
    rng, rows, labels = np.random.default_rng(seed), [], []
    sign = np.array([-1.0 if name == REVERSED else 1.0 for name in ANGLES])
    for k in range(6):
        for d in (*np.linspace(-0.004, 0.003, 8), *np.linspace(0.002, -0.003, 5)):
            row = np.full(6, -0.008)
            row[k] = d
            rows.append(sign * row)
            labels.append(f'pull{k}')
    for p in range(8):
        size, phase = rng.uniform(0.001, 0.003, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
        for t in np.linspace(0.0, 1.0, 12):
            turn = np.radians(list(ANGLES.values())) - np.repeat(phase + t, 3)
            rows.append(sign * np.repeat(size * np.sin(np.pi * t), 3) * np.cos(turn))
            labels.append(f'move{p}')
    return 0.5 * np.arange(len(rows)), np.array(rows), np.array(labels)


def recorded(seed: int = 1, noise: float = 1e-3) -> Recording:
    time, moved, labels = motion(seed)
    robot = true()
    body = TendonBody(robot)
    late = np.stack([np.interp(time - robot.actuation.delay, time, one) for one in moved.T], 1)
    marker = np.array([0.004, 0.001, -0.002])
    model = Model(body.rod, body.tendons, body.load, body.wound(late), body.T_map_base, marker)
    history = follow(model)
    assert history.reached.all()
    tip = history.tip + noise * np.random.default_rng(seed).normal(size=history.tip.shape)
    return Recording(time, tuple(ANGLES), moved, tip, labels)


@pytest.fixture(scope='module')
def found():
    return identify(bare(), recorded(), ARM)


def test_every_motor_is_found_at_its_end_with_its_sign_and_angle(found):
    wanted = {tendon.name: tendon for tendon in true().actuation.tendons}
    for tendon in found.robot.actuation.tendons:
        assert (tendon.end, tendon.sign) == (wanted[tendon.name].end, wanted[tendon.name].sign)
        off = (tendon.azimuth_deg - wanted[tendon.name].azimuth_deg + 180.0) % 360.0 - 180.0
        assert abs(off) < 4.0
        assert tendon.offset == pytest.approx(wanted[tendon.name].offset, abs=4e-4)


def test_what_is_left_is_the_noise_and_patterns_held_out_are_predicted(found):
    # Three axes of 1 mm each are 1.73 mm.
    assert 1.4 < found.figures()['tip RMSE, fit [mm]'] < 1.8
    assert found.figures()['tip RMSE, patterns held out [mm]'] < 3.0
    assert 0.6 < found.nees.mean() < 1.6


def test_another_recording_is_predicted(found):
    error, _ = predict(found.robot, recorded(seed=7))
    assert rmse(error) < 2.2


def test_reversed_motor_and_slack_tendon_are_named_and_no_other(found):
    said = ' '.join(found.findings)
    assert f"'{REVERSED}' pulls by going down" in said and f"'{SLACK}' hangs by 1." in said
    assert len(found.findings) == 2


def test_a_motor_that_does_not_move_the_tip_is_broken():
    recording = recorded()
    rows = alone(recording, 0)
    tip = recording.tip.copy()
    tip[rows] = tip[rows[0]]
    assert not broken(recording, 0, ENDS[-1], ARM)
    assert broken(replace(recording, tip=tip), 0, ENDS[-1], ARM)


def test_slopes_of_the_tip_are_those_of_finite_differences():
    recording = recorded(noise=0.0)
    search = Identification(true(), recording)
    z = np.zeros(len(search.sigma))
    slope = search._slopes(z).slope
    for name in ('offset', 'EI', 'friction', 'marker', 'radius'):
        first = sum(len(one.sigma) for one in search.unknowns[: _place(search, name)])
        ahead, behind = z.copy(), z.copy()
        ahead[first] += 1e-3
        behind[first] -= 1e-3
        wanted = (follow(search.model(ahead)).tip - follow(search.model(behind)).tip) / 2e-3
        assert np.abs(slope[..., first] - wanted).max() < 0.05 * np.abs(wanted).max(), name


def _place(search: Identification, name: str) -> int:
    return [one.name for one in search.unknowns].index(name)


def test_a_pattern_lies_in_one_fold():
    pattern = np.array(['a', 'b', 'a', 'c', 'b'])
    fold = folds_of(pattern)
    assert fold[0] == fold[2] and fold[1] == fold[4] and len(set(fold)) == 3


def test_a_motor_that_never_moved_alone_is_asked_for():
    recording = recorded()
    with pytest.raises(CalibrationError, match='m4.*record each of them'):
        identify(bare(), _without(recording, 'pull3'), ARM)
    with pytest.raises(CalibrationError, match='--arm'):
        identify(bare(), recording)


def _without(recording: Recording, pattern: str) -> Recording:
    keep = recording.pattern != pattern
    return Recording(
        recording.time[keep],
        recording.motors,
        recording.moved[keep],
        recording.tip[keep],
        recording.pattern[keep],
    )


def test_tables_and_bags_hold_the_same_recording(tmp_path):
    recording = recorded()
    table = tmp_path / 'moves.csv'
    rows = [
        'timestamp,pattern_label,' + ','.join(f'{m}_mm' for m in ANGLES) + ',tip_x,tip_y,tip_z'
    ]
    for t, label, d, x in zip(
        recording.time, recording.pattern, recording.moved, recording.tip, strict=True
    ):
        rows.append(f'{t},{label}_hold,' + ','.join(f'{1e3 * v}' for v in (*d, *x)))
    table.write_text('\n'.join(rows) + '\n')
    read = read_csv(table)
    assert read.motors == recording.motors and np.array_equal(read.pattern, recording.pattern)
    assert np.allclose(read.moved, recording.moved) and np.allclose(read.tip, recording.tip)
    assert len(together([read, read]).time) == len(read.time)
    write_bag(tmp_path / 'bag', samples(recording, 'marker'))
    bag = read_recording(tmp_path / 'bag', bare())
    assert bag.motors == recording.motors and np.allclose(bag.tip, recording.tip)
    assert np.allclose(bag.moved, recording.moved, atol=1e-9)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('', 'names nothing'),
        ('timestamp,a_mm,tip_x,tip_y\n', 'needed are'),
        ('timestamp,a_mm,b_N,tip_x,tip_y,tip_z\n', 'one unit'),
        ('timestamp,a_mm,tip_x,tip_y,tip_z\n0,1,2,3,x\n', 'line 2: not a number'),
        ('timestamp,a_mm,tip_x,tip_y,tip_z\n0,1,2,3,4\n', '1 rows'),
    ],
)
def test_a_table_that_cannot_be_used_says_why(tmp_path, text, said):
    path = tmp_path / 'bad.csv'
    path.write_text(text)
    with pytest.raises(BagError, match=said):
        read_csv(path)
