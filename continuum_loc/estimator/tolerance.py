"""What a healthy sensor may differ by from its description: what people build, 1 sigma each."""

from __future__ import annotations

import numpy as np

# Of a ToF sensor, the bias of its ranges included [m, rad].
MOUNT = np.repeat([0.006, np.radians(1.2)], 3)
GYRO_AXES = np.radians(2.0)
GYRO_SCALE = 0.02
CLOCK = 0.005  # [s] between sensors of one kind; what all share is no matter of one sensor
# Of a base, as sensors see it that sit a little off, on a map that may stand a little off.
BASE = np.repeat([0.005, np.radians(1.0)], 3)
