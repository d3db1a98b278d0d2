"""The drawing of the viewer's page, run by Node.js where it is installed."""

import json
from pathlib import Path
import shutil
import subprocess

import continuum_loc
import pytest

SCRIPT = Path(continuum_loc.__file__).parent / 'nodes' / 'viewer.js'
pytestmark = pytest.mark.skipif(shutil.which('node') is None, reason='Node.js is not installed')


def node(program):
    done = subprocess.run(['node', '-e', program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def evaluated(expression):
    return node(
        f'const page = require({json.dumps(str(SCRIPT))});'
        f'process.stdout.write(JSON.stringify({expression}))'
    )


@pytest.mark.parametrize(
    ('yaw', 'pitch', 'point', 'place'),
    [
        # Seen from +x, 2 m away, on 400 x 200 pixels: y is to the right, z is up, and half a
        # metre at the distance of the centre is 50 pixels.
        (0.0, 0.0, (1, 0, 0), (200, 100)),
        (0.0, 0.0, (1, 0.5, 0.25), (250, 75)),
        (0.0, 0.0, (2, 0.5, 0), (300, 100)),  # half as far from the eye: twice as large
        (1.5707963267948966, 0.0, (0.5, 0, 0), (250, 100)),  # from +y, x is to the left
        (0.0, 1.5707963267948966, (0.5, 0.5, 0), (250, 50)),  # from above
    ],
)
def test_a_point_is_drawn_where_perspective_puts_it(yaw, pitch, point, place):
    view = json.dumps({'yaw': yaw, 'pitch': pitch, 'distance': 2, 'centre': [1, 0, 0]})
    found = evaluated(f'page.project({view}, 400, 200, {point[0]}, {point[1]}, {point[2]})')
    assert found[:2] == pytest.approx(place, abs=1e-9)


def test_what_is_behind_the_eye_is_not_drawn():
    view = '{ yaw: 0, pitch: 0, distance: 2, centre: [0, 0, 0] }'
    assert evaluated(f'page.project({view}, 400, 200, 3, 0, 0)') is None


def test_the_view_fits_the_map_and_without_one_the_body():
    rings = {'x': [0, 2], 'y': [1, 1], 'z': [0, -1]}
    room = {'x': [-4, 4], 'y': [0, 1], 'z': [0, 1]}
    none = {'x': [], 'y': [], 'z': []}
    assert evaluated(f'page.bounds({json.dumps({"map": none, "rings": rings})})') == {
        'centre': [1, 1, -0.5],
        'size': 2,
    }
    assert evaluated(f'page.bounds({json.dumps({"map": room, "rings": rings})})')['size'] == 8
    assert evaluated(f'page.bounds({json.dumps({"map": none})})') is None


@pytest.mark.parametrize(('scale', 'metres'), [(100, 1), (37, 2), (3000, 0.02), (23, 5)])
def test_the_scale_is_a_round_length_of_at_most_120_pixels(scale, metres):
    assert evaluated(f'page.roundLength({scale}, 120)') == pytest.approx(metres)


def test_the_page_draws_what_the_node_serves():
    def points(number):
        return {axis: [0.1 * k for k in range(number)] for axis in 'xyz'}

    state = {'reconstruction': points(20), 'new': points(3), 'truth': points(5)}
    state |= {'backbone': points(7), 'rings': points(5), 'map_version': 1}
    state |= {'status': [[2, '<b>lost</b>']]}
    answers = json.dumps({'state.json': state, 'map.json': points(11)})
    browser = Path(__file__).with_name('browser.js').read_text()
    found = node(f'const answers = {answers};\n{browser}\n{SCRIPT.read_text()}')
    assert found['fillRect'] == 20 + 3 + 11 + 1  # the points, and the scale's bar
    assert (found['arc'], found['legend']) == (5 + 5, 6)
    assert found['lineTo'] == 7 + 3  # the backbone, and the axes
    assert found['text'][:3] == ['x', 'y', 'z'] and found['text'][3].endswith(' m')
    assert found['status'] == [['bad', '<b>lost</b>']]
