"""
Hypothesis draws the same examples in every run, so that no chance breaks a test.

Only a change does. To search anew: HYPOTHESIS_PROFILE=explore make test.
"""

import os
import re
import sys

from hypothesis import settings
import pytest

settings.register_profile('same', derandomize=True)
settings.register_profile('explore')
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'same'))


class NodeModule(pytest.Module):
    """Tests that need a ROS graph: skipped before their imports fail where there is no rclpy."""

    def collect(self):
        pytest.importorskip('rclpy', reason='rclpy is not installed')
        return super().collect()


def pytest_pycollect_makemodule(module_path, parent):
    if re.search(r'^(from|import) (rclpy|node_graph)\b', module_path.read_text(), re.MULTILINE):
        return NodeModule.from_parent(parent, path=module_path)
    return None


@pytest.fixture(scope='module', autouse=True)
def nothing_left_behind():
    """Nodes of a failed test would go on, and take the processor from the tests that follow."""
    yield
    if 'node_graph' in sys.modules:
        sys.modules['node_graph'].clean_up()
