"""Every sensor's factor; the filter makes one of each kind that its setup wants."""

from __future__ import annotations

from continuum_loc.estimator.factors.base import ClockScores, Factor, FactorReport, Guess, Setup
from continuum_loc.estimator.factors.base_pose import BasePoseFactor
from continuum_loc.estimator.factors.field import FieldFactor
from continuum_loc.estimator.factors.gravity import GravityFactor
from continuum_loc.estimator.factors.gyro import GyroFactor
from continuum_loc.estimator.factors.mechanics import MechanicsFactor
from continuum_loc.estimator.factors.pose import InsertionFactor, TrackerFactor
from continuum_loc.estimator.factors.strain import StrainFactor
from continuum_loc.estimator.factors.tof import TofFactor

FACTORS: tuple[type[Factor], ...] = (
    GyroFactor,
    StrainFactor,
    TrackerFactor,
    InsertionFactor,
    BasePoseFactor,
    MechanicsFactor,
    GravityFactor,
    FieldFactor,
    TofFactor,
)

__all__ = ['ClockScores', 'FACTORS', 'Factor', 'FactorReport', 'Guess', 'Setup', 'TofFactor']
