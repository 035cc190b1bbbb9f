"""Rows of a sparse system of linear equations in units of one sigma, real or complex, collected by blocks."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix

from orthoswarm.model.arrays import Indices


@dataclass(slots=True)
class SparseRows:
    """Equations of `size` unknowns; the rows of a block may share a robust weight."""

    size: int
    count: int = 0
    parts: list[tuple[Indices, NDArray[Any], NDArray[Any]]] = field(default_factory=list)
    sides: list[NDArray[Any]] = field(default_factory=list)

    def add(self, right: NDArray[Any], *terms: tuple[ArrayLike, ArrayLike]) -> None:
        """Add a row for each element of `right`: each term is (columns, values), with one of both for each row."""
        row = self.count + np.arange(len(right))
        for column, value in terms:
            self.parts.append((row, np.broadcast_to(column, row.shape), np.broadcast_to(value, row.shape)))
        self.sides.append(right)
        self.count += len(right)

    def matrix(self) -> coo_matrix:
        """The matrix (rows, size)."""
        row, column, value = (np.concatenate([p[k] for p in self.parts]) for k in range(3))
        return coo_matrix((value, (row, column)), shape=(self.count, self.size))

    def right(self) -> NDArray[Any]:
        """The right-hand side (rows,)."""
        return np.concatenate(self.sides)
