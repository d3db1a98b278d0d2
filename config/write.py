"""
Write the nodes' YAML files from their typed settings, so that defaults are written down once.

    python config/write.py
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from continuum_loc.nodes.support.parameters import constraint, leaves
from continuum_loc.nodes.support.settings import (
    DriverNodeSettings,
    EstimatorNodeSettings,
    RecorderNodeSettings,
    ReplayerNodeSettings,
    ShapeNodeSettings,
    SimulatorNodeSettings,
    ViewerNodeSettings,
)
from continuum_loc.settings import Settings
import yaml

WIDTH = 112
NODES: dict[str, Settings] = {
    'simulator': SimulatorNodeSettings(),
    'estimator': EstimatorNodeSettings(),
    'shape': ShapeNodeSettings(),
    'recorder': RecorderNodeSettings(),
    'replayer': ReplayerNodeSettings(),
    'driver': DriverNodeSettings(),
    'viewer': ViewerNodeSettings(),
}
FILTER_NOTE = """\
    # Every setting of the filter is a parameter too, named as in
    # continuum_loc/estimator/settings.py, and comes before those of `settings`; a change while
    # the node runs starts the estimate anew. `ros2 param list /estimator` names them,
    # `ros2 param describe /estimator filter.tof.gate` explains one.
    # filter.tof.gate: 0.12
"""


def config_text(node: str) -> str:
    """Write the commented YAML of a node's parameters at their defaults."""
    head = (
        f'# Parameters of node `{node}` at their defaults, '
        'by `python config/write.py`.\n'
        f'#   ros2 run continuum_loc {node} --ros-args --params-file {node}.yaml -p name:=value\n'
        '# [live] may change while the node runs (`ros2 param set`); the others are refused then.'
        '\n/**:\n  ros__parameters:\n'
    )
    return head + ''.join(_entries(NODES[node])) + (FILTER_NOTE if node == 'estimator' else '')


def _entries(settings: Settings) -> Iterator[str]:
    for name, field, value in leaves(settings, ''):
        limits = constraint(field)
        live = bool((field.json_schema_extra or {}).get('live'))
        notes = [
            field.description or '',
            f'({limits})' if limits else '',
            '[live]' if live else '',
        ]
        yield _comment(' '.join(note for note in notes if note))
        yield f'    {name}: {_text(value)}\n'


def _comment(text: str) -> str:
    lines, line = [], '    #'
    for word in text.split():
        if len(line) + len(word) + 1 > WIDTH:
            lines.append(line)
            line = '    #'
        line += ' ' + word
    return ''.join(f'{item}\n' for item in (*lines, line))


def _text(value: Any) -> str:
    value = list(value) if isinstance(value, tuple) else value
    if isinstance(value, float):
        return repr(value)
    return yaml.safe_dump(value, default_flow_style=True).removesuffix('...\n').strip()


def main() -> None:
    """Write all files beside this one."""
    for node in NODES:
        Path(__file__).with_name(f'{node}.yaml').write_text(config_text(node))


if __name__ == '__main__':
    main()
