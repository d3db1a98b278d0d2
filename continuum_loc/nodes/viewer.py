"""Node `viewer`: watch the graph in a browser, where there is no RViz (see config/viewer.yaml)."""

from __future__ import annotations

from functools import partial
from pathlib import Path
import sys
from typing import Any

from continuum_loc.errors import MessageError
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.quality import input_qos
from continuum_loc.nodes.support.runtime import deserialized, run
from continuum_loc.nodes.support.settings import ViewerNodeSettings
from continuum_loc.nodes.support.web import answers_of, Seen, Server, SHOWN
from msg_tools.topics import topic_spec
from rclpy.qos import DurabilityPolicy

PAGE = Path(__file__).parent / 'viewer.html'
SCRIPT = PAGE.with_suffix('.js')


class ViewerNode(PackageNode):
    """Keeps the newest of everything and serves it; the page asks five times a second."""

    def __init__(self, **options: Any) -> None:
        super().__init__('viewer', ViewerNodeSettings(), **options)
        self.check_parameters()
        self.seen = Seen(self.settings.map_points, self.settings.cloud_points)

    def configure(self) -> None:
        """Serve the page, which is empty yet."""
        server = self._serve()
        self.undo(server.server_close)
        self.undo(server.shutdown)
        host, port = server.server_address[:2]
        self.get_logger().info(f'watch at http://{host}:{port}/')

    def activate(self) -> None:
        """Hear what is shown."""
        for topic in (*SHOWN, '/diagnostics'):
            spec = topic_spec(topic)
            qos = input_qos(spec, spec.latched)
            if spec.latched:
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self.listen(spec.type, topic, partial(self._receive, topic), qos, raw=True)

    def _receive(self, topic: str, data: bytes) -> None:
        try:
            if len(data) > self.settings.largest_message:
                raise MessageError('size', f'{topic}: {len(data)} bytes are too many to show')
            spec = topic_spec(topic)
            self.seen.take(topic, spec.decode(deserialized(data, spec.type), None, topic))
        except Exception as error:  # what is damaged is not shown, and what comes next is
            self.get_logger().warning(str(error), throttle_duration_sec=10.0)

    def _serve(self) -> Server:
        answers = answers_of(self.seen, PAGE.read_bytes(), SCRIPT.read_bytes())
        server = Server(self.settings.host, self.settings.port, answers)
        self.thread(server.serve_forever, 'http').start()
        return server


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(ViewerNode, args))


if __name__ == '__main__':
    main()
