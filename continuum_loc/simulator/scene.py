"""What a scene is: a mesh for sensors, convex pieces for contact, its departures from as-built."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TYPE_CHECKING

from continuum_loc.simulator.solids import mesh_of
import numpy as np

if TYPE_CHECKING:
    from continuum_loc.simulator.solids import Part
    from manifold3d import Manifold


@dataclass(frozen=True, eq=False)
class Anomaly:
    """
    What a scene has that its as-built version has not (`added`), or the reverse (`missing`).

    `vertices` (V, 3) and `faces` (F, 3) bound the solid that was added or taken away, in the map
    frame.
    """

    name: str
    kind: Literal['added', 'missing']
    vertices: np.ndarray
    faces: np.ndarray

    @cached_property
    def centre(self) -> np.ndarray:
        """(3,) centre of the bounding box [m]."""
        return 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))

    @cached_property
    def size(self) -> float:
        """Longest edge of the bounding box [m]."""
        return float(np.ptp(self.vertices, axis=0).max())


@dataclass(frozen=True, eq=False)
class Scene:
    """
    A watertight environment in the map frame.

    vertices: (V, 3) float64 [m]. faces: (F, 3) int32, counter-clockwise seen from free space.
    face_object: (F,) int32, index into `objects` of the part that each face belongs to.
    reflectance: (F,) share of infrared light that a face reflects at normal incidence.
    hulls: (n, 3) vertices of each convex piece within the robot's reach, for contact.
    anomalies: how the scene departs from its as-built version.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    face_object: np.ndarray
    objects: tuple[str, ...]
    reflectance: np.ndarray
    hulls: tuple[np.ndarray, ...]
    anomalies: tuple[Anomaly, ...] = field(default=())

    def __post_init__(self) -> None:
        for array in (self.vertices, self.faces, self.face_object, self.reflectance):
            array.setflags(write=False)  # scenes are cached and shared

    @cached_property
    def face_normals(self) -> np.ndarray:
        """(F, 3) unit normals, towards free space."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def scene_of_solid(
    name: str,
    solid: Manifold,
    owners: np.ndarray,
    parts: list[Part],
    anomalies: tuple[Anomaly, ...] = (),
) -> Scene:
    """Make the scene of united parts; `owners` (F,) are the faces' parts (see `solids.unite`)."""
    vertices, faces = mesh_of(solid)
    reflectance = np.array([part.reflectance for part in parts])[owners]
    hulls = tuple(hull for part in parts for hull in part.hulls)
    return Scene(
        name,
        vertices,
        faces,
        owners,
        tuple(part.name for part in parts),
        reflectance,
        hulls,
        anomalies,
    )
