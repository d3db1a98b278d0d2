"""Node `viewer`: watch the graph in a browser, where there is no RViz (see config/viewer.yaml)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
from pathlib import Path
import sys
import threading
from typing import Any

from continuum_loc.errors import MessageError, SettingsError
from continuum_loc.nodes.support.runtime import input_qos, PackageNode, run
from continuum_loc.nodes.support.settings import ViewerNodeSettings
from continuum_loc.scene.anomalies import AnomalySettings
from msg_tools.records import CloudRecord, DiagnosticsRecord, PathRecord
from msg_tools.topics import topic_spec
import numpy as np
from rclpy.qos import DurabilityPolicy

SHOWN = {
    'poses': 'rings',
    'shape/poses': 'rings',
    'backbone': 'backbone',
    'shape/curve': 'backbone',
    'ground_truth/poses': 'truth',
    'reconstruction': 'reconstruction',
    'prior_map': 'map',
}
NEW = 'new'  # what the map does not show
PAGE = Path(__file__).parent / 'viewer.html'
SCRIPT = PAGE.with_suffix('.js')
NOTHING = {'x': [], 'y': [], 'z': []}


class ViewerNode(PackageNode):
    """Keeps the newest of everything and serves it; the page asks five times a second."""

    def __init__(self, **options: Any) -> None:
        super().__init__('viewer', ViewerNodeSettings(), **options)
        self.check_parameters()
        self.newest = dict.fromkeys((*SHOWN.values(), NEW), NOTHING)
        self.status: dict[str, tuple[int, str]] = {}
        self.map_version = 0
        self.server = self._serve()
        for topic in (*SHOWN, '/diagnostics'):
            spec = topic_spec(topic)
            qos = input_qos(spec, spec.latched)
            if spec.latched:
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self.listen(spec.type, topic, partial(self._receive, topic), qos)
        host, port = self.server.server_address[:2]
        self.get_logger().info(f'watch at http://{host}:{port}/')

    def close(self) -> None:
        """Stop serving."""
        self.server.shutdown()
        self.server.server_close()

    def state(self) -> dict[str, Any]:
        """Return what the page shows, without the map."""
        shown = {name: points for name, points in self.newest.items() if name != 'map'}
        return shown | {
            'status': [self.status[name] for name in sorted(self.status)],
            'map_version': self.map_version,
        }

    def _receive(self, topic: str, message: Any) -> None:
        try:
            item = topic_spec(topic).decode(message, None, topic)
        except MessageError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=10.0)
            return
        if isinstance(item, DiagnosticsRecord):
            self.status |= {
                name: (level, f'{name}: {text}') for name, level, text, _ in item.statuses
            }
            return
        self.newest[SHOWN[topic]] = self._columns(topic, item)
        if topic == 'reconstruction':
            self.newest[NEW] = self._columns(topic, _new_points(item))
        self.map_version += topic == 'prior_map'

    def _columns(self, topic: str, item: Any) -> dict[str, list[float]]:
        if isinstance(item, CloudRecord):
            most = self.settings.map_points if topic == 'prior_map' else self.settings.cloud_points
            points = item.points[:: max(1, -(-len(item.points) // max(most, 1)))][:most]
        else:
            T = (
                item.T_map_backbone
                if isinstance(item, PathRecord)
                else getattr(item, 'T_map_body', None)
            )
            points = (item.T_map_ring if T is None else T)[:, :3, 3]
        return (
            dict(zip('xyz', np.round(points.T, 4).tolist(), strict=True))
            if len(points)
            else NOTHING
        )

    def _serve(self) -> ThreadingHTTPServer:
        answers = {
            '/': ('text/html', PAGE.read_bytes),
            '/viewer.js': ('text/javascript', SCRIPT.read_bytes),
            '/state.json': ('application/json', lambda: json.dumps(self.state()).encode()),
            '/map.json': ('application/json', lambda: json.dumps(self.newest['map']).encode()),
        }
        try:
            server = ThreadingHTTPServer(
                (self.settings.host, self.settings.port), partial(_Handler, answers)
            )
        except OSError as error:
            raise SettingsError(
                f'cannot serve on {self.settings.host}:{self.settings.port} ({error.strerror}); '
                'choose another `port`, or 0 for a free one'
            ) from None
        threading.Thread(target=server.serve_forever, name='http', daemon=True).start()
        return server


def _new_points(cloud: CloudRecord) -> CloudRecord:
    """Those of the reconstructed points that lie off the map (eq. 12)."""
    anomaly = cloud.fields.get('anomaly', np.zeros(len(cloud.points)))
    chosen = anomaly**2 > AnomalySettings().tau
    return CloudRecord(cloud.stamp, {name: v[chosen] for name, v in cloud.fields.items()})


class _Handler(BaseHTTPRequestHandler):
    def __init__(self, answers: dict[str, tuple[str, Callable[[], bytes]]], *args: Any) -> None:
        self.answers = answers
        super().__init__(*args)

    def do_GET(self) -> None:
        kind, content = self.answers.get(self.path, ('', None))
        if content is None:
            self.send_error(404)
            return
        body = content()
        self.send_response(200)
        self.send_header('Content-Type', f'{kind}; charset=utf-8')
        self.send_header('Content-Length', str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Five requests a second are nothing to log."""


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(ViewerNode, args))


if __name__ == '__main__':
    main()
