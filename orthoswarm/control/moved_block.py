"""A block's cameras and ground after a similarity in the plane."""

from dataclasses import replace

import numpy as np

from orthoswarm.model.arrays import Floats
from orthoswarm.model.camera import Camera
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plane_similarity import Similarity


def moved_camera(camera: Camera, similarity: Similarity, level_m: float, up_m: float = 0.0) -> Camera:
    """A camera after a similarity; heights over a level are scaled, too, so that no pixel's ray is bent.

    camera: before it. level_m: of the ground. up_m: added to its height.
    """
    height = float(similarity.moved_heights(camera.position[2], level_m)) + up_m
    position = np.array([*similarity.moved(camera.nadir), height])
    return replace(camera, position=position, rotation=similarity.about_up @ camera.rotation)


def moved_terrain(terrain: Terrain, similarity: Similarity, level_m: float) -> Terrain:
    """The ground after a similarity, on nodes as far apart as before.

    terrain: before it. level_m: heights over this level are scaled.
    """
    rows, columns = terrain.z.shape
    step = terrain.step_m
    if rows <= 2 and columns <= 2 and terrain.bare is None and float(np.ptp(terrain.z)) == 0.0:
        return terrain  # a level plane
    west, south = terrain.west, terrain.south
    east, north = west + (columns - 1) * step, south + (rows - 1) * step
    corners = similarity.moved(np.array([[west, south], [east, south], [east, north], [west, north]]))
    low = np.floor(corners.min(axis=0) / step) * step
    count = np.ceil((corners.max(axis=0) - low) / step).astype(int) + 1
    empty = Terrain(float(low[0]), float(low[1]), step, np.zeros(count[::-1], np.float32))
    before = similarity.back(empty.nodes())

    def moved(z: Floats) -> Floats:
        heights = replace(terrain, z=z).height(before)
        return np.asarray(similarity.moved_heights(heights, level_m), np.float32)

    return terrain.changed(moved, west=float(low[0]), south=float(low[1]))
