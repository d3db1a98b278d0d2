"""
The ROS 2 nodes: `simulator`, `estimator`, `shape`, `recorder`, `replayer`.

Only modules in here import rclpy.
"""
