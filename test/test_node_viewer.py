"""Node `viewer`: what is on the graph is what the browser gets."""

import json
import re
import urllib.error
import urllib.request

from continuum_loc import lie
from continuum_loc.nodes.viewer import SCRIPT
from msg_tools.records import CloudRecord, DiagnosticsRecord, PathRecord, PosesRecord
from node_graph import Client, fresh_domain, Process
import numpy as np
import pytest

pytestmark = pytest.mark.timeout(200)


def test_the_browser_gets_what_is_published(tmp_path):
    domain = fresh_domain()
    node = Process('viewer', domain, tmp_path, port=0, map_points=50)
    node.await_log('watch at')
    url = re.search(r'http://[\d.:]+/', node.log)[0]

    def get(name):
        with urllib.request.urlopen(url + name, timeout=20) as answer:
            return answer.read()

    assert b'viewer.js' in get('') and get('viewer.js') == SCRIPT.read_bytes()
    with pytest.raises(urllib.error.HTTPError, match='404'):
        get('../settings.py')
    rng = np.random.default_rng(0)
    T = lie.exp(rng.normal(size=(4, 6)))
    columns = {name: rng.normal(size=200) for name in ('x', 'y', 'z')}
    cloud = CloudRecord(1, columns | {'anomaly': np.where(np.arange(200) < 30, np.inf, 1.0)})
    with Client(domain) as client:
        items = {
            'poses': PosesRecord(1, T),
            'backbone': PathRecord(1, T),
            'reconstruction': cloud,
            'prior_map': cloud,
            '/diagnostics': DiagnosticsRecord(1, (('estimator', 2, 'lost', {}),)),
        }
        for topic in items:
            client.publisher(topic)
        client.await_listeners(*items)
        for topic, item in items.items():
            client.send(topic, item)
        assert client.until(
            lambda: (state := json.loads(get('state.json')))['map_version'] and state['status']
        )
    state, points = json.loads(get('state.json')), json.loads(get('map.json'))
    np.testing.assert_allclose(
        np.transpose([state['rings'][a] for a in 'xyz']), T[:, :3, 3], atol=1e-4
    )
    np.testing.assert_allclose(
        np.transpose([state['backbone'][a] for a in 'xyz']), T[:, :3, 3], atol=1e-4
    )
    assert state['status'] == [[2, 'estimator: lost']]
    assert len(points['x']) == 50 and len(state['reconstruction']['x']) == 200
    assert len(state['new']['x']) == 30
    assert node.stop() == 0, node.log
