"""Sphinx settings of the API documentation: `make docs`, or rosdoc2, which finds this file."""

from pathlib import Path
import re
import sys

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

project = 'continuum_loc'
author = 'continuum_loc maintainers'
extensions = ['sphinx.ext.autodoc', 'sphinx.ext.autosummary']
autosummary_generate = True
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
autodoc_default_options = {'members': True, 'show-inheritance': True}
# Not everybody who reads has these; types of them are named all the same.
autodoc_mock_imports = [
    'rclpy',
    'rcl_interfaces',
    'geometry_msgs',
    'std_srvs',
    'rosgraph_msgs',
    'mujoco',
    'manifold3d',
    'coacd',
    'open3d',
    'trimesh',
    'distributed',
]
html_theme = 'alabaster'


def _as_written(app, what, name, obj, options, lines):
    """Docstrings are plain text: keep their lines, show `names` as code, and nothing else."""
    lines[:] = [f'| {_escaped(line)}' if line.strip() else '' for line in lines]


def _escaped(line: str) -> str:
    parts = line.split('`')
    if len(parts) % 2 == 0:
        return re.sub(r'([\\*_|`])', r'\\\1', line)
    written = ''
    for place, part in enumerate(parts):
        if place % 2 == 0:
            glue = '\\ ' if place and part[:1].isalnum() else ''  # as in `name`s
            written += glue + re.sub(r'([\\*_|])', r'\\\1', part)
        elif part.strip():
            written += f'``{part}``'
    return written


def setup(app):
    """Connect the above."""
    app.connect('autodoc-process-docstring', _as_written)
