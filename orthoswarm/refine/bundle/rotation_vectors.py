"""Rotation matrices and rotation vectors (axis times angle), both ways."""

import numpy as np

from orthoswarm.model.arrays import Array


def exp_rotation(vector: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=1)
    a = np.where(angle < 1e-8, 1.0, np.sin(angle) / np.maximum(angle, 1e-12))[:, None, None]
    b = np.where(angle < 1e-4, 0.5, (1.0 - np.cos(angle)) / np.maximum(angle, 1e-12) ** 2)[:, None, None]
    k = np.zeros((len(vector), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vector[:, 2], vector[:, 1], -vector[:, 0]
    k -= np.swapaxes(k, 1, 2)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def log_rotation(rotation: Array) -> Array:
    """Rotation vectors (N, 3) of rotation matrices (N, 3, 3)."""
    cosine = np.clip((np.trace(rotation, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    angle = np.arccos(cosine)
    vector = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    scale = np.where(angle < 1e-6, 0.5, angle / np.maximum(2.0 * np.sin(angle), 1e-9))
    return np.asarray(vector * scale[:, None])
