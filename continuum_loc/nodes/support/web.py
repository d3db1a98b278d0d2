"""
What node `viewer` shows, and the server that gives it to a browser.

Whatever the graph sends and whoever connects, both stay bounded. Nothing here imports rclpy.
"""

from __future__ import annotations

from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import ipaddress
import json
import socket
import threading
import time
from typing import Any
from urllib.parse import urlsplit

from continuum_loc.errors import SettingsError
from continuum_loc.scene.anomalies import AnomalySettings
from msg_tools.records import CloudRecord, DiagnosticsRecord, PathRecord
import numpy as np

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
NOTHING = {'x': [], 'y': [], 'z': []}
MOST_NAMES, MOST_TEXT = 40, 200  # lines of status, and characters of each
MOST_CONNECTIONS = 32
ASKED_WITHIN, ANSWERED_WITHIN = 5.0, 60.0  # s; then a connection is closed, whatever it does
Answers = dict[
    str, tuple[str, Callable[[], bytes]]
]  # by path: kind of content, and how to make it


class Seen:
    """
    The newest of everything.

    map_points, cloud_points: the most that is kept of the map, and of anything else.
    """

    def __init__(self, map_points: int, cloud_points: int) -> None:
        self.most = {'map': map_points}
        self.else_most = cloud_points
        self.newest = dict.fromkeys((*SHOWN.values(), NEW), NOTHING)
        self.map_version = 0
        self._status: dict[str, tuple[int, str]] = {}
        self._left_out = 0

    def take(self, topic: str, item: Any) -> None:
        """Take what came on a topic, decoded."""
        if isinstance(item, DiagnosticsRecord):
            self._take_status(item)
            return
        name = SHOWN[topic]
        self.newest[name] = self._columns(name, item)
        if topic == 'reconstruction':
            self.newest[NEW] = self._columns(NEW, _new_points(item))
        self.map_version += topic == 'prior_map'

    def state(self) -> dict[str, Any]:
        """Return what the page shows, without the map."""
        shown = {name: points for name, points in self.newest.items() if name != 'map'}
        status = [list(self._status[name]) for name in sorted(self._status)]
        if self._left_out:
            status.append([1, f'more than {MOST_NAMES} names: the newest are shown'])
        return shown | {'status': status, 'map_version': self.map_version}

    def _take_status(self, item: DiagnosticsRecord) -> None:
        """Keep the newest of each name; of more names than there is room for the newest ones."""
        status = dict(self._status)
        for name, level, text, _ in item.statuses[-MOST_NAMES:]:
            status.pop(name[:MOST_TEXT], None)
            status[name[:MOST_TEXT]] = min(max(level, 0), 3), f'{name}: {text}'[:MOST_TEXT]
        self._left_out += max(len(item.statuses), len(status)) > MOST_NAMES
        self._status = dict(list(status.items())[-MOST_NAMES:])

    def _columns(self, name: str, item: Any) -> dict[str, list[float]]:
        if isinstance(item, CloudRecord):
            points = item.points
        else:
            T = (
                item.T_map_backbone
                if isinstance(item, PathRecord)
                else getattr(item, 'T_map_body', None)
            )
            points = (item.T_map_ring if T is None else T)[:, :3, 3]
        most = self.most.get(name, self.else_most)
        points = points[:: max(1, -(-len(points) // max(most, 1)))][:most]
        points = points[np.isfinite(points).all(axis=1)]  # a browser's JSON knows no NaN
        return (
            dict(zip('xyz', np.round(points.T, 4).tolist(), strict=True))
            if len(points)
            else NOTHING
        )


def _new_points(cloud: CloudRecord) -> CloudRecord:
    """Those of the reconstructed points that lie off the map (eq. 12)."""
    anomaly = cloud.fields.get('anomaly', np.zeros(len(cloud.points)))
    chosen = anomaly**2 > AnomalySettings().tau
    return CloudRecord(cloud.stamp, {name: v[chosen] for name, v in cloud.fields.items()})


def answers_of(seen: Seen, page: bytes, script: bytes) -> Answers:
    """List what the server has: the page, its script, and what was seen."""
    return {
        '/': ('text/html', lambda: page),
        '/plotly.js': ('text/javascript', lambda: script),
        '/state.json': ('application/json', lambda: json.dumps(seen.state()).encode()),
        '/map.json': ('application/json', lambda: json.dumps(seen.newest['map']).encode()),
    }


class Server(ThreadingHTTPServer):
    """
    Serves `answers` to at most MOST_CONNECTIONS at a time, each for a limited time.

    Raises SettingsError where it cannot serve at (host, port).
    """

    def __init__(self, host: str, port: int, answers: Answers) -> None:
        self.answers = answers
        self._names = {'localhost'}
        self._open: dict[socket.socket, float] = {}  # until when it may stay so
        self._lock = threading.Lock()
        try:
            self._local = ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
            super().__init__((host, port), _Handler)
        except OSError as error:
            raise SettingsError(
                f'cannot serve on {host}:{port} ({error.strerror}); choose another `port`, or 0 '
                'for a free one'
            ) from None
        if not self._local:
            own = socket.gethostname().lower()
            self._names |= {own, f'{own}.local', socket.getfqdn().lower()}

    def knows(self, host: str) -> bool:
        """
        Whether a request for `host` is meant for this server.

        Another name that leads here is somebody's who has a browser ask us in his name. Addresses
        are nobody's names; on this machine alone, those of this machine.
        """
        try:
            name = (urlsplit(f'//{host}').hostname or '').rstrip('.')
            return name in self._names or (
                ipaddress.ip_address(name).is_loopback or not self._local
            )
        except ValueError:
            return False

    def extend(self, connection: socket.socket) -> None:
        """Give a connection that has asked the time to get its answer."""
        with self._lock:
            self._open[connection] = time.monotonic() + ANSWERED_WITHIN

    def process_request(self, request: Any, client_address: Any) -> None:
        """Take a connection, unless there are too many."""
        with self._lock:
            full = len(self._open) >= MOST_CONNECTIONS
            if not full:
                self._open[request] = time.monotonic() + ASKED_WITHIN
        if full:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Twice a second: end the connections whose time is over."""
        now = time.monotonic()
        with self._lock:
            late = [one for one, until in self._open.items() if until < now]
        for one in late:
            try:
                one.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # it has gone by itself

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser may leave, and time runs out, at any point."""


class _Handler(BaseHTTPRequestHandler):
    server: Server
    timeout = ANSWERED_WITHIN

    def do_GET(self) -> None:
        self.server.extend(self.connection)
        known = self.server.knows(self.headers.get('Host', ''))
        kind, content = self.server.answers.get(self.path, ('', None))
        if not known or content is None:
            self.send_error(404 if known else 403)
            return
        body = content()
        self.send_response(200)
        self.send_header('Content-Type', f'{kind}; charset=utf-8')
        self.send_header('Content-Length', str(len(body)))
        self.send_header('Cache-Control', 'no-store')
        self.send_header('X-Content-Type-Options', 'nosniff')
        self.send_header('X-Frame-Options', 'DENY')
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Five requests a second are nothing to log."""
