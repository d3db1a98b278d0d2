"""The viewer's page and server stay bounded, whatever the graph sends and whoever connects."""

import json
from pathlib import Path
import socket
import threading
import time
import urllib.error
import urllib.request

from continuum_loc.errors import SettingsError
from continuum_loc.nodes.support import web
from continuum_loc.nodes.support.web import answers_of, MOST_CONNECTIONS, Seen, Server
from msg_tools.records import CloudRecord, DiagnosticsRecord, PathRecord, PosesRecord
import numpy as np
import pytest

PAGE = Path(web.__file__).parents[1] / 'viewer.html'


@pytest.fixture
def seen():
    return Seen(map_points=50, cloud_points=20)


@pytest.fixture
def server(seen, monkeypatch):
    monkeypatch.setattr(web, 'ASKED_WITHIN', 1.0)
    made = Server('127.0.0.1', 0, answers_of(seen, b'page', b'script'))
    thread = threading.Thread(target=made.serve_forever)
    thread.start()
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


def get(server, path='/', host=None):
    port = server.server_address[1]
    request = urllib.request.Request(f'http://127.0.0.1:{port}{path}')
    if host is not None:
        request.add_header('Host', host)
    with urllib.request.urlopen(request, timeout=20) as answer:
        return answer.read(), dict(answer.headers)


def status(seen):
    return seen.state()['status']


def test_two_hundred_thousand_diagnostics_stay_a_short_page(seen):
    """They made a page of 110 MB once."""
    one = DiagnosticsRecord(1, tuple((f'node {k}', 1, 'x' * 500, {}) for k in range(200_000)))
    for _ in range(3):
        seen.take('/diagnostics', one)
    for k in range(1000):
        seen.take('/diagnostics', DiagnosticsRecord(1, ((f'other {k}', 0, 'fine', {}),)))
    assert len(json.dumps(seen.state())) < 20_000
    lines = [text for _, text in status(seen)]
    assert 'other 999: fine' in lines and 'other 0: fine' not in lines
    assert lines[-1] == 'more than 40 names: the newest are shown'


def test_the_newest_of_each_name_is_shown_at_a_level_the_page_knows(seen):
    for level, text in ((2, 'lost'), (0, 'tracking'), (77, 'odd')):
        seen.take('/diagnostics', DiagnosticsRecord(1, (('estimator', level, text, {}),)))
    assert status(seen) == [[3, 'estimator: odd']]


def test_points_are_bounded_and_what_is_no_number_is_left_out(seen):
    """A browser does not read NaN, and would say that the node has gone."""
    cloud = CloudRecord(1, {name: np.arange(10_000.0) for name in 'xyz'})
    cloud.fields['x'][::2] = np.nan
    poses = np.tile(np.eye(4), (5000, 1, 1))
    poses[0, 0, 3] = np.inf
    seen.take('reconstruction', cloud)
    seen.take('prior_map', cloud)
    seen.take('poses', PosesRecord(1, poses))
    seen.take('backbone', PathRecord(1, poses))
    assert len(seen.newest['map']['x']) <= 50
    for name in ('reconstruction', 'rings', 'backbone'):
        assert len(seen.newest[name]['x']) <= 20
    json.loads(json.dumps([seen.state(), seen.newest['map']]), parse_constant=pytest.fail)


def test_names_are_text_and_no_markup(seen):
    name = '<img src=x onerror=alert(1)>'
    seen.take('/diagnostics', DiagnosticsRecord(1, ((name, 0, '</script>', {}),)))
    assert status(seen) == [[0, f'{name}: </script>']]
    page = PAGE.read_text()
    assert 'textContent: text' in page
    for door in ('innerHTML', 'outerHTML', 'insertAdjacentHTML', 'document.write', 'eval('):
        assert door not in page


def test_state_comes_as_json_that_no_browser_takes_for_a_page(server, seen):
    seen.take('poses', PosesRecord(1, np.eye(4)[None]))
    body, headers = get(server, '/state.json')
    assert json.loads(body)['rings'] == {'x': [0.0], 'y': [0.0], 'z': [0.0]}
    assert headers['Content-Type'].startswith('application/json')
    assert headers['X-Content-Type-Options'] == 'nosniff'
    assert 'Access-Control-Allow-Origin' not in headers
    for path in ('/../settings.py', '/state.json?x', '//etc/passwd'):
        with pytest.raises(urllib.error.HTTPError, match='404'):
            get(server, path)


@pytest.mark.parametrize(
    'host',
    [
        'evil.example',
        'evil.example:8765',
        '127.0.0.1.evil.example',
        '192.168.1.7',
        '[',
        '',
        'localhost.evil.example',
        '127.0.0.1@evil.example',
    ],
)
def test_a_name_that_somebody_else_made_lead_here_gets_nothing(server, host):
    """A page of theirs would else read what this robot does (DNS rebinding)."""
    with pytest.raises(urllib.error.HTTPError, match='403'):
        get(server, '/state.json', host)


@pytest.mark.parametrize('host', ['localhost', 'LOCALHOST:9', '127.0.0.1:1', '[::1]:80'])
def test_this_machines_own_names_are_known(server, host):
    assert get(server, '/', host)[0] == b'page'


def test_where_other_machines_may_watch_they_ask_by_address_or_by_the_machines_name(monkeypatch):
    monkeypatch.setattr(socket, 'gethostname', lambda: 'Bench7')
    with Server('0.0.0.0', 0, {}) as made:
        assert (
            made.knows('192.168.1.7:8765') and made.knows('bench7') and made.knows('bench7.local')
        )
        assert not made.knows('evil.example') and not made.knows('')


def test_connections_that_never_ask_are_limited_and_closed(server):
    """Three times as many as there is room for, each with a byte now and then."""
    address = server.server_address
    held = [socket.create_connection(address, timeout=20) for _ in range(3 * MOST_CONNECTIONS)]
    for one in held:
        one.sendall(b'GET / HTTP/1.1\r\nX-')
    deadline = time.monotonic() + 60.0
    answered = None
    while answered is None and time.monotonic() < deadline:
        for one in held:  # a header that never ends
            try:
                one.sendall(b'a')
            except OSError:
                pass
        assert sum(thread.name.startswith('Thread') for thread in threading.enumerate()) < 60
        try:
            answered = get(server)[0]
        except OSError:
            time.sleep(0.1)
    assert answered == b'page'
    for one in held:
        one.close()


def test_a_port_in_use_is_named(server):
    with pytest.raises(SettingsError, match=r'cannot serve on 127.0.0.1:\d+ .*another `port`'):
        Server('127.0.0.1', server.server_address[1], {})
