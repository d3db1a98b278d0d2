"""Calibration: what a robot's recordings say of the robot itself."""
