"""
Every launch file starts, with a namespace and with frames of its own, and ends cleanly.

Where ROS is installed: `launch_test test/launch/every_file.py` (`make test-launch`).
"""

import os
import tempfile
import time
import unittest

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare
import launch_testing
from launch_testing.actions import ReadyToTest
from launch_testing.asserts import assertExitCodes
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

PATIENCE = 300.0  # s; the first start on a machine compiles
ARM = {'robot': 'soft_arm', 'scene': 'R0', 'trajectory': 'b1', 'duration': '120.0'}
FILES = {
    'estimator': ({'robot': 'soft_arm'}, {'poses', 'tip', 'body', 'ring_pose/base'}),
    'live': (ARM, {'poses', 'tof/points', 'imu/data_raw', 'ground_truth/poses'}),
    'everything': (ARM | {'rviz': 'false', 'viewer': 'true'}, {'poses', 'tof/points'}),
    'shape': (
        {'simulate': 'true', 'duration': '120.0'},
        {'shape/poses', 'shape/curve', 'imu/mag'},
    ),
}


@launch_testing.parametrize('name', sorted(FILES))
def generate_test_description(name):
    """One of them, as robot `left`, in a folder of its own."""
    os.chdir(tempfile.mkdtemp())
    path = PathJoinSubstitution([FindPackageShare('continuum_loc'), 'launch', f'{name}.launch.py'])
    given = FILES[name][0] | {'namespace': 'left'}
    file = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(path), launch_arguments=given.items()
    )
    return LaunchDescription([file, ReadyToTest()]), {}


class TestRunning(unittest.TestCase):
    """What there is on the graph while it runs."""

    @classmethod
    def setUpClass(cls):
        rclpy.init()
        cls.node = rclpy.create_node('watcher')

    @classmethod
    def tearDownClass(cls):
        cls.node.destroy_node()
        rclpy.shutdown()

    def wait_for(self, condition):
        """Spin until it is so; False where it never is."""
        deadline = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < deadline:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        return condition()

    def test_its_topics_are_in_its_namespace_and_its_frames_have_its_prefix(
        self, proc_output, name
    ):
        """Two robots started by the same file never meet."""
        proc_output.assertWaitFor('ready: robot', timeout=PATIENCE, stream='stderr')
        wanted = {f'/left/{topic}' for topic in FILES[name][1]}
        assert self.wait_for(
            lambda: wanted <= {topic for topic, _ in self.node.get_topic_names_and_types()}
        )
        if name != 'shape':
            heard = []
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.node.create_subscription(TFMessage, '/tf_static', heard.append, latched)
            assert self.wait_for(lambda: heard)
            frames = {one.child_frame_id for one in heard[0].transforms}
            frames |= {one.header.frame_id for one in heard[0].transforms}
            assert frames and all(frame.startswith('left_') for frame in frames), frames


@launch_testing.post_shutdown_test()
class TestEnded(unittest.TestCase):
    """What comes of an end."""

    def test_every_process_ends_cleanly(self, proc_info):
        """Each has exit code 0."""
        assertExitCodes(proc_info)
