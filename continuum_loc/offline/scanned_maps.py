"""
Maps as a scanner makes them of a place, in a frame that is a little off.

In a world that departs from the estimator's files the estimator gets such a map; of what is drawn
here it learns nothing else.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from continuum_loc import lie
from continuum_loc.closure import digest_of_code
from continuum_loc.mapping.build import local_shape
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.simulator.departures import Departures, Scan, stream_of
import numpy as np
from scipy.spatial import cKDTree


def scanned_map_file(nominal: Path, departures: Departures, seed: int) -> Path:
    """
    Name the file of the map that the estimator is given in place of the `nominal` one.

    It lies beside it, made once for each seed by this code.
    """
    code = digest_of_code(__name__, presets=False)
    said = f'{departures.scan!r} {departures.map_frame!r} {seed} {code}'
    digest = hashlib.sha256(said.encode()).hexdigest()[:12]
    path = nominal.with_name(f'{nominal.stem}-scanned-{digest}.npz')
    if not path.is_file():
        partial = path.with_name(f'{path.stem}.{os.getpid()}.npz')
        scanned(load_map(nominal), departures, seed).save(partial)
        partial.replace(path)  # atomic: another process sees all of it or nothing
    return path


def scanned(prior: PriorMap, departures: Departures, seed: int) -> PriorMap:
    """Make of a map what a scanner makes of the place, in a frame that is a little off."""
    if departures.scan:
        prior = _scan(prior, departures.scan, stream_of(seed, 'scan'))
    if departures.map_frame:
        T = departures.map_frame.drawn(stream_of(seed, 'map_frame'))
        prior = _moved(prior, T)
    return prior


def _scan(prior: PriorMap, scan: Scan, rng: np.random.Generator) -> PriorMap:
    """
    Points with noise and without holes; normals and planarity by PCA of what is left.

    The scanner knows on which side of the surface it stood, and its noise is in its data sheet.
    """
    centres = prior.points[rng.integers(len(prior), size=scan.holes)]
    kept = np.ones(len(prior), bool)
    for near in cKDTree(prior.points).query_ball_point(centres, scan.hole_radius):
        kept[near] = False
    normals = prior.normals[kept]
    points = prior.points[kept] + scan.noise * rng.standard_normal((kept.sum(), 3))
    planarity, found = local_shape(points, normals)
    found = np.where(np.einsum('ij,ij->i', found, normals) < 0.0, -1.0, 1.0)[:, None] * found
    return PriorMap(
        points,
        found,
        planarity,
        sigma=max(scan.noise, prior.sigma),
        spacing=prior.spacing,
        oriented=prior.oriented,
        source=prior.source,
        seed=prior.seed,
    )


def T_map_scene(prior: PriorMap, departures: Departures, seed: int) -> np.ndarray:
    """(4, 4) from the scene's frame to that of the map that is made of it, `prior` being exact."""
    if not departures.map_frame:
        return np.eye(4)
    if departures.scan:
        prior = _scan(prior, departures.scan, stream_of(seed, 'scan'))
    return _about_middle(prior, departures.map_frame.drawn(stream_of(seed, 'map_frame')))


def _moved(prior: PriorMap, T: np.ndarray) -> PriorMap:
    """Turn the map about its middle, and shift it."""
    return prior.moved(_about_middle(prior, T))


def _about_middle(prior: PriorMap, T: np.ndarray) -> np.ndarray:
    middle = np.eye(4)
    middle[:3, 3] = prior.points.mean(axis=0)
    return middle @ T @ lie.inverse(middle)
