"""
The report shows the figures of the run and needs no network.

It loses no peak on the way to a picture.
"""

from dataclasses import replace
import re

from continuum_loc.measurements import NANOSECONDS
from continuum_loc.offline.figures import ceiling, spans, thin
from continuum_loc.offline.metrics import errors
from continuum_loc.offline.replay import replay
from continuum_loc.offline.report import Context, run_page, worst_moments, write_report
from continuum_loc.offline.runs import load_run, new_run, save_run, settled
from continuum_loc.offline.tables import latex, markdown, write_table
from continuum_loc.offline.view import clipped, moments, smooth_backbone, surroundings
from continuum_loc.robot import load_robot
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from synthetic import NoisyFilter, samples

ROBOT = load_robot('engine')
CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    result = replay(samples(ROBOT, 4.0), NoisyFilter(ROBOT))
    late = result.track.T_map_ring.copy()
    late[20, 5, 0, 3] += 0.08  # one bad moment at t = 2 s, at the tip
    result = replace(
        result, track=replace(result.track, T_map_ring=late), latency_seconds=np.full(40, 0.0123)
    )
    folder = new_run('replay', tmp_path_factory.mktemp('runs'))
    save_run(folder, result, kind='replay', seed=3, configuration={'robot': ROBOT, 'scene': 'S0'})
    return load_run(folder)


@pytest.fixture(scope='module')
def page(run):
    return write_report(run, Context((CUBE, CUBE_FACES), CUBE)).read_text()


def test_report_is_one_file_that_needs_no_network(page):
    markup = re.sub(r'<script.*?</script>', '', page, flags=re.S)
    assert not re.findall(r'(?:src|href)\s*=\s*"(?!#)', markup)
    assert 'cdn.plot.ly' not in re.sub(r'<script>.{100000,}?</script>', '', page, flags=re.S)
    assert len(page) < 15e6


def test_report_shows_the_figures_of_the_summary(run, page):
    assert f'{100 * run.summary["translation_mae_m"]:.2f} cm' in page
    assert f'{run.summary["rotation_mae_deg"]:.2f}°' in page
    assert '12.3 ms' in page  # the latency
    for ring in ROBOT.ring_names:
        assert (
            f'<td class="">{100 * run.summary["rings"][ring]["translation_mae_m"]:.2f}</td>'
            in page
        )


def test_the_worst_moment_comes_first_and_leads_to_its_frame(run, page):
    worst = next(
        part
        for group in run_page(run, Context()).groups
        for part in group
        if part.title.startswith('Worst')
    )
    first = worst.table.rows[0]
    assert first.cells[:2] == ['2.00', 'ring5']
    shown = moments(
        run.result, 90, 100, 0.5, extra=errors(settled(run.result.track), run.result.truth).stamps
    )
    assert (shown[first.frame].stamp - run.result.track.stamps[0]) / NANOSECONDS == pytest.approx(
        2.0
    )
    assert f'data-frame="{first.frame}"' in page


def test_worst_moments_are_apart_and_sorted(run):
    found = errors(settled(run.result.track), run.result.truth)
    worst = worst_moments(found)
    peaks = found.translation_m[worst, 1:].max(axis=1)
    assert np.all(np.diff(peaks) <= 0.0)
    assert np.diff(np.sort(found.stamps[worst])).min() >= NANOSECONDS // 2


def test_a_report_without_truth_says_so(run, tmp_path):
    blind = replace(
        run.result, truth=run.result.truth.select(np.zeros(len(run.result.truth), bool))
    )
    folder = new_run('replay', tmp_path)
    save_run(folder, blind, kind='replay', seed=None, configuration={})
    text = write_report(load_run(folder)).read_text()
    assert 'No truth was recorded' in text
    assert 'Worst moments' not in text


def test_names_from_outside_cannot_inject_markup(run, tmp_path):
    folder = new_run('replay', tmp_path)
    save_run(
        folder,
        run.result,
        kind='replay',
        seed=0,
        configuration={'scene': '<script>alert(1)</script>'},
    )
    assert '<script>alert(1)' not in write_report(load_run(folder)).read_text()


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300), st.integers(1, 50))
@settings(max_examples=60, deadline=None)
def test_thinning_keeps_the_greatest(values, most):
    values = np.array(values)
    kept = thin(values, most)
    assert len(kept) <= max(most, 1) or len(values) <= most
    assert values[kept].max() == values.max()
    assert np.all(np.diff(kept) > 0)


def test_spans_of_flags():
    time = np.arange(6.0)
    assert spans(time, np.array([1, 1, 0, 0, 1, 0], bool)) == [(0.0, 1.0), (4.0, 4.0)]
    assert spans(time, np.zeros(6, bool)) == []


def test_smooth_backbone_follows_an_arc():
    from synthetic import poses_at

    true_s = np.linspace(0.0, 1.5, 41)
    coarse = smooth_backbone(poses_at(ROBOT, np.linspace(0.0, 1.5, 6), 1.0)[None])[0]
    fine = poses_at(ROBOT, true_s, 1.0)[:, :3, 3]
    gap = np.linalg.norm(coarse[:, None] - fine[None], axis=-1).min(axis=0)
    # Cubic Hermite over an arc of 0.3 rad deviates by about angle^4 / 384 of its length, plus the
    # sampling of 4 cm.
    assert gap.max() < 0.02
    np.testing.assert_allclose(coarse[[0, -1]], fine[[0, -1]], atol=1e-12)


def test_clipping_a_cube_leaves_the_area_inside():
    vertices, faces = clipped(CUBE, CUBE_FACES, np.full(3, -2.0), np.array([0.5, 2.0, 2.0]))
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    # Of the six sides of 4 m2, the far one goes and four keep three quarters.
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(
        4.0 + 4 * 3.0
    )
    assert vertices[faces][..., 0].max() <= 0.5 + 1e-12


def test_surroundings_stay_within_reach_and_number(run):
    rng = np.random.default_rng(0)
    around = surroundings(run.result, None, rng.uniform(-5, 5, (20000, 3)), 0.3, 100, 50)
    body = smooth_backbone(run.result.track.T_map_ring).reshape(-1, 3)
    assert 0 < len(around.map_points) <= 50
    assert np.all(around.map_points >= body.min(axis=0) - 0.3)
    assert np.all(around.map_points <= body.max(axis=0) + 0.3)


def test_tables_as_text():
    pd = pytest.importorskip('pandas')
    frame = pd.DataFrame(
        [
            {'scene': 'S0', 'MAE_cm': 0.123456, 'n': 3, 'note': 'a|b'},
            {'scene': 'S1', 'MAE_cm': None},
        ]
    )
    lines = markdown(frame).splitlines()
    assert lines[0] == '| scene | MAE_cm | n | note |'
    assert lines[2] == r'| S0 | 0.1235 | 3 | a\|b |'
    assert lines[3] == '| S1 | - | - | - |'
    assert r'MAE\_cm' in latex(frame)
    assert latex(frame).count(r'\\') == 3


def test_a_table_read_back_is_the_table(tmp_path):
    import pandas as pd

    rows = [{'name': 'a', 'value': 1.0 / 3.0}, {'name': 'b', 'value': 1e-300}]
    write_table(rows, tmp_path / 't')
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / 't.csv'), pd.DataFrame(rows))
    assert {path.suffix for path in tmp_path.iterdir()} == {'.csv', '.json', '.md', '.tex'}


def test_a_rare_peak_of_the_band_does_not_hide_the_errors():
    values, band = np.full(200, 0.1), np.full(200, 0.3)
    band[77] = 8.0
    assert ceiling(values, band) == pytest.approx(0.33)
    values[5] = 1.0  # an error is never cut off
    assert ceiling(values, band) == pytest.approx(1.1)
    assert ceiling(values, np.full(200, np.nan)) == pytest.approx(1.1)
