"""Forces on the simulated body: what it touches, and what pushes it on purpose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Push:
    """A force (3,) [N] in the map on the node nearest to arclength s [m], in [start, end) [s]."""

    s: float
    force: tuple[float, float, float]
    start: float = 0.0
    end: float = float('inf')


def push(
    data: Any, nodes: np.ndarray, nodes_s: np.ndarray, pushes: tuple[Push, ...], time: float
) -> None:
    """Have the pushes of an instant act; nodes (N + 1,) are the bodies at arclengths `nodes_s`."""
    data.xfrc_applied[nodes] = 0.0
    for one in pushes:
        if one.start <= time < one.end:
            node = nodes[np.argmin(np.abs(nodes_s - one.s))]
            data.xfrc_applied[node, :3] += one.force


def contact_forces(model: Any, data: Any, nodes: np.ndarray) -> np.ndarray:
    """(N + 1, 3) forces [N] in the map by which contacts push the bodies `nodes` (N + 1,)."""
    import mujoco

    total, wrench = np.zeros((model.nbody, 3)), np.zeros(6)
    for number, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, number, wrench)
        # In the contact's frame, whose first axis points from the first geom to the second.
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        first, second = model.geom_bodyid[contact.geom]
        total[second] += force
        total[first] -= force
    return total[nodes]
