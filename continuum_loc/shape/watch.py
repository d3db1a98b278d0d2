"""
Axes, units and wiring of all modules while the robot moves.

Each gyro is held against the accelerometer of its own chip. What is left is held against all
modules together: where their joint fit is bad, and would be good with another wiring, a reversed
magnet or one kind of sensor turned, that is the cause.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations

from continuum_loc import plausible
from continuum_loc.measurements import nanoseconds, seconds
from continuum_loc.robot import RobotDescription
from continuum_loc.shape.backbone import BackboneFit
from continuum_loc.shape.estimate import Faults
from continuum_loc.shape.modules import Module
from continuum_loc.shape.poses import PoseSolver, Snapshot
from continuum_loc.shape.settings import ShapeSettings
import numpy as np

STALE = 2.5  # sample periods: older readings do not belong to one time
CLEARLY = 0.2  # of the misfit: a cause leaves no more of it
UNSEEN = np.cos(
    np.radians(45.0)
)  # a turned sensor that passed its rest turns what it read no more
ITERATIONS = 12  # of a fit on trial: a fit to the right cause takes fewer

Trial = tuple[dict[str, str], Snapshot]  # what would be wrong, by module, and all modules without


class Watch:
    """
    Looks every `settings.watch` seconds at `modules`, and says what it found, by module.

    wiring: modules that are swapped, a reversed magnet, or no cause; judged anew at each look.
    turned: sensors with other axes or units. These do not change while a robot runs, so they are
    named once two looks agree, and from then on.
    """

    def __init__(
        self,
        robot: RobotDescription,
        settings: ShapeSettings,
        solver: PoseSolver,
        modules: Sequence[Module],
    ) -> None:
        self._solver, self._modules = solver, modules
        self._period, self._misfit = nanoseconds(settings.watch), settings.misfit
        self._stale = STALE / robot.hall_model.rate
        self._next = self._next_turns = 0
        self._seen: dict[str, str] = {}
        self.wiring: dict[str, str] = {}
        self.turned: dict[str, str] = {}
        self.consistency = np.nan

    @property
    def faults(self) -> Faults:
        """All that was found, by module."""
        both = (self.turned, self.wiring)
        return {
            module.name: tuple(found[module.name] for found in both if module.name in found)
            for module in self._modules
            if any(module.name in found for found in both)
        }

    def due(self, stamp: int) -> bool:
        """Whether it is time for a joint fit to look at."""
        return stamp >= self._next

    def look(self, now: Snapshot, joint: BackboneFit) -> None:
        """Judge by a joint fit, if it is time, and if all readings are of one time."""
        self.consistency = joint.consistency
        oldest = min(min(module.imu.stamp, module.hall.stamp) for module in self._modules)
        if not self.due(now.stamp) or seconds(now.stamp, oldest) >= self._stale:
            return
        self._next = now.stamp + self._period
        seen = {
            module.name: f'imu {text}'
            for module in self._modules
            if (text := plausible.turns_and_gravity(module.turns))
        }
        self.wiring = {}
        if joint.consistency > self._misfit:
            self.wiring, turned = self._causes(now, joint.consistency)
            seen = turned | seen
        self.turned |= {name: text for name, text in seen.items() if self._seen.get(name) == text}
        self._seen = seen

    def _causes(self, now: Snapshot, misfit: float) -> tuple[dict[str, str], dict[str, str]]:
        """Find the wiring, or the turned sensors, that would explain a joint fit so bad."""
        rewired = self._best(_rewired(now, self._modules), misfit)
        if rewired is not None:
            return rewired, {}
        turned = self._best(_turned(now, self._modules), misfit)
        if turned is not None:
            return {}, turned
        return {module.name: 'does not fit the backbone' for module in self._modules}, {}

    def _best(self, trials: Iterator[Trial], misfit: float) -> dict[str, str] | None:
        """Choose the trial with the best fit, where it explains the misfit."""
        tried = [(self._solver.joint(on, ITERATIONS).consistency, wrong) for wrong, on in trials]
        best, wrong = min(tried, key=lambda one: one[0])
        return wrong if best <= CLEARLY * misfit else None


def _rewired(now: Snapshot, modules: Sequence[Module]) -> Iterator[Trial]:
    """Every order of the modules, with the magnet as described and upside down."""
    names = [module.name for module in modules]
    for order in permutations(range(len(names))):
        wrong = {
            names[which]: f'swapped with {names[place]}'
            for place, which in enumerate(order)
            if place != which
        }
        index = list(order)
        for sign in (1.0, -1.0):
            yield (
                wrong if sign > 0.0 else dict.fromkeys(names, 'magnet upside down'),
                replace(
                    now,
                    good=now.good[index],
                    R_base_module=now.R_base_module[index],
                    field_base=sign * now.field_base[index],
                    earth=sign * now.earth,
                    attitude=now.attitude[index],
                ),
            )


def _turned(now: Snapshot, modules: Sequence[Module]) -> Iterator[Trial]:
    """One kind of sensor with other axes, on all modules or on one of them."""
    for axes in plausible.SIGNED_AXES[1:]:
        kinds = {'hall': [m for m in modules if _unseen(axes, m.rest_field)]}
        if np.linalg.det(axes) > 0.0:  # others contradict gravity when they turn
            kinds['imu'] = [m for m in modules if _unseen(axes, m.rest_accel)]
        for kind, some in kinds.items():
            for group in ([some] if len(some) > 1 else []) + [[module] for module in some]:
                wrong = f'{kind} axes turned? {plausible.named(axes)} would fit'
                turn = _with_turned_hall if kind == 'hall' else _with_turned_imu
                yield {m.name: wrong for m in group}, turn(now, group, axes)


def _unseen(axes: np.ndarray, read: np.ndarray) -> bool:
    """Whether turned axes leave what was read at rest about as it is."""
    return bool((axes @ read) @ read > UNSEEN * (read @ read))


def _with_turned_hall(now: Snapshot, group: Sequence[Module], axes: np.ndarray) -> Snapshot:
    field_base = now.field_base.copy()
    for module in group:
        R_base_hall = now.R_base_module[module.place] @ module.R_module_hall
        field_base[module.place] = R_base_hall @ axes @ R_base_hall.T @ field_base[module.place]
    return replace(now, field_base=field_base)


def _with_turned_imu(now: Snapshot, group: Sequence[Module], axes: np.ndarray) -> Snapshot:
    R, field_base = now.R_base_module.copy(), now.field_base.copy()
    for module in group:
        m = module.place
        R[m] = module.R_base_module_if(now.stamp, axes)
        field_base[m] = R[m] @ now.R_base_module[m].T @ field_base[m]  # as read in the module
    return replace(now, R_base_module=R, field_base=field_base)
