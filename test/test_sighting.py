"""A ToF sensor is judged by what is left once it may sit a little off."""

from dataclasses import replace

from continuum_loc.measurements import TofFrame
import numpy as np
from scipy.spatial.transform import Rotation
from test_doubts import followed
from worlds import rod


def of_tof(name, change):
    def altered(sample):
        return change(sample) if isinstance(sample, TofFrame) and sample.sensor == name else sample

    return altered


def upside_down(frame):
    """Give every zone the range of the one in the opposite row."""
    model = rod().tof_model
    shape = (model.rows, model.columns)
    ranges = np.flip(frame.ranges.reshape(shape), 0).ravel()
    finite = np.isfinite(ranges)[:, None]
    points = np.where(finite, np.where(finite, ranges[:, None], 0.0) * model.directions, np.nan)
    return replace(frame, ranges=ranges, points=points)


def turned(degrees):
    """Turn a sensor's points about an axis across its beam."""
    R = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
    return lambda frame: replace(frame, points=frame.points @ R.T)


def said(change):
    made = followed(of_tof('r2_tof1', change), 3.0)
    found = {}
    for estimate in made:
        found |= estimate.suspects
    return found


def test_rows_of_one_sensor_are_named_and_nobody_else():
    assert said(upside_down) == {'r2_tof1': 'rows of zones the other way round?'}


def test_a_mount_is_off_by_a_degree_and_not_by_twenty():
    """One degree is what people build, however many standard deviations of a zone it is."""
    assert said(turned(1.0)) == {}
    assert said(turned(20.0)) == {'r2_tof1': 'does not fit'}
