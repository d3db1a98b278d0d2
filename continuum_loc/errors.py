"""
Everything that this package raises on purpose.

Each message names what was wrong, where, and what is valid. `InputError`s are the user's to mend:
the command line tells them in one line. What is raised and is none of these is a bug.
"""

from __future__ import annotations


class ContinuumLocError(Exception):
    """The root of the family."""


class InputError(ContinuumLocError, ValueError):
    """Something that was given cannot be used."""


class SettingsError(InputError):
    """A settings file, or a value in one."""


class MapError(InputError):
    """A map, cloud, mesh or reconstruction."""


class SceneError(InputError):
    """A scene of the simulator."""


class MessageError(InputError):
    """
    A message that cannot be converted.

    kind: short name of the class of error (`size`, `type`, `stamp`, `frame`, ...), under which
    it is counted.
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class MeasurementError(InputError):
    """
    A measurement that an estimator cannot use.

    reason: the short name under which it is counted.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class BagError(InputError):
    """A bag, or a folder of them, that cannot be read, written or judged."""


class QueryError(InputError):
    """An instant or a place of which an estimator can say nothing."""


class FrameError(InputError):
    """Frames between which there is no way, or none at that time."""


class TrajectoryError(InputError):
    """A trajectory, or a file of one."""


class CalibrationError(InputError):
    """A calibration that the samples do not allow."""


class MotionError(InputError):
    """The robot moved, or did not rest long enough, where it has to rest."""


class RunError(InputError):
    """A folder that holds no run, or a damaged one."""


class TuneError(InputError):
    """A bag that cannot be tuned on."""


class StudyError(InputError):
    """A study or benchmark that does not exist or cannot be run as asked."""


class NotInstalled(InputError):
    """A library that only some uses need is not installed; the message says what to type."""


class SingularError(ContinuumLocError, ArithmeticError):
    """An elimination met a matrix that is not positive definite; `column` says at which one."""

    def __init__(self, column: int) -> None:
        super().__init__(
            f'the information of column {column} is not positive definite: some of its '
            'directions are not observed by any measurement or prior'
        )
        self.column = column


class RunFailure(ContinuumLocError, RuntimeError):
    """Something that was started and did not come to its end."""


class SimulationDiverged(RunFailure):
    """The simulated robot left the range in which its mechanics hold."""


class LiveError(RunFailure):
    """A node that did not start, or died."""


class DomainError(RunFailure):
    """No DDS domain is free."""
