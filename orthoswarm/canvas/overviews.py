"""Reduced copies of a canvas, so that a view of 100 km2 reads kilobytes per tile and not megabytes.

Two files hold the canvas reduced 8 and 64 times, block by block (a tile's block is contiguous, so a tile that was
never drawn stays a hole in the file). Colours are means over the drawn pixels, alpha is the drawn share.
"""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.errors import StorageError

Bytes = NDArray[np.uint8]
FACTORS = (8, 64)


_PAIR = np.uint32(0x00FF00FF)
_MOST = 16  # side of a block whose sums fit into 16 bits


@in_place_kernel
def _reduce_partly_drawn(source, factor, i, j, target):  # type: ignore[no-untyped-def]
    """One block's mean over what is drawn of it."""
    red = green = blue = weight = np.int64(0)
    for y in range(i * factor, (i + 1) * factor):
        for x in range(j * factor, (j + 1) * factor):
            pixel = np.int64(source[y, x])
            a = pixel >> 24
            red += a * (pixel & 255)
            green += a * ((pixel >> 8) & 255)
            blue += a * ((pixel >> 16) & 255)
            weight += a
    half = weight >> 1
    if weight > 0:
        target[i, j, 0] = (red + half) // weight
        target[i, j, 1] = (green + half) // weight
        target[i, j, 2] = (blue + half) // weight
        # at least 1, so that a lone pixel is not lost to a reader that asks "is anything there"
        target[i, j, 3] = max(1, (weight + factor * factor // 2) // (factor * factor))
    else:
        target[i, j, 0] = target[i, j, 1] = target[i, j, 2] = target[i, j, 3] = 0


@in_place_kernel
def _reduce(source, factor, target):  # type: ignore[no-untyped-def]
    """Means of blocks; two channels of a packed pixel are summed at once in the halves of a word."""
    rows, cols = target.shape[0], target.shape[1]
    none, eight, sixteen, low = np.uint32(0), np.uint32(8), np.uint32(16), np.uint32(0xFFFF)
    pixels, shift = np.uint32(factor * factor), none
    while np.uint32(1) << shift < pixels:
        shift += np.uint32(1)
    half = pixels >> np.uint32(1)
    for i in range(rows):
        for j in range(cols):
            red_blue, green_alpha = none, none
            for y in range(i * factor, (i + 1) * factor):
                row = source[y, j * factor : (j + 1) * factor]
                for x in range(row.shape[0]):
                    red_blue += row[x] & _PAIR
                    green_alpha += (row[x] >> eight) & _PAIR
            if green_alpha >> sixteen == np.uint32(255) * pixels:
                target[i, j, 0] = ((red_blue & low) + half) >> shift
                target[i, j, 1] = ((green_alpha & low) + half) >> shift
                target[i, j, 2] = ((red_blue >> sixteen) + half) >> shift
                target[i, j, 3] = 255
            elif green_alpha >> sixteen == none:
                target[i, j, 0] = target[i, j, 1] = target[i, j, 2] = target[i, j, 3] = 0
            else:
                _reduce_partly_drawn(source, factor, i, j, target)


def reduce_rgba(rgba: Bytes, factor: int) -> Bytes:
    """Mean colours of factor x factor blocks, uint8 (rows / factor, columns / factor, 4); alpha is the drawn share.

    Args:
        rgba: uint8 (rows, columns, 4), both sides multiples of factor.
        factor: side of a block in pixels, a power of two.
    """
    if factor > _MOST:
        return reduce_rgba(reduce_rgba(rgba, _MOST), factor // _MOST)
    out = np.empty((rgba.shape[0] // factor, rgba.shape[1] // factor, 4), np.uint8)
    _reduce(np.ascontiguousarray(rgba).view(np.uint32)[..., 0], factor, out)
    return out


class Overview:
    """The reduced copies of a canvas of tile_rows x tile_cols tiles.

    Args:
        folder: the canvas's folder.
        tile_rows: rows of tiles. tile_cols: columns of tiles. tile_px: side of a tile, a multiple of 64.
        writable: False only reads.
    """

    def __init__(self, folder: Path, tile_rows: int, tile_cols: int, tile_px: int, *, writable: bool = True) -> None:
        self._cols = tile_cols
        self._sides = {factor: tile_px // factor for factor in FACTORS}
        mode = os.O_RDWR | os.O_CREAT if writable else os.O_RDONLY
        mode |= getattr(os, "O_BINARY", 0)
        self._files = {factor: os.open(folder / f"overview{factor}.rgba", mode, 0o644) for factor in FACTORS}
        del tile_rows  # the files grow as tiles come

    def close(self) -> None:
        """Close the files."""
        for descriptor in self._files.values():
            os.close(descriptor)
        self._files = {}

    def put(self, row: int, col: int, rgba: Bytes | None) -> None:
        """Store a tile's reduced copies; None for a tile that is gone.

        Raises:
            StorageError: if the disk is full.
        """
        small = rgba
        done = 1
        for factor in FACTORS:
            side = self._sides[factor]
            small = np.zeros((side, side, 4), np.uint8) if small is None else reduce_rgba(small, factor // done)
            if rgba is None:
                block, small = small, None
            else:
                block = small
            done = factor
            _write(self._files[factor], block.tobytes(), (row * self._cols + col) * block.nbytes)

    def read(self, factor: int, row0: int, row1: int, col0: int, col1: int) -> Bytes:
        """The blocks of tiles [row0, row1) x [col0, col1) at one of FACTORS, as one picture."""
        side = self._sides[factor]
        size = side * side * 4
        out = np.empty(((row1 - row0) * side, (col1 - col0) * side, 4), np.uint8)
        for row in range(row0, row1):
            data = _read(self._files[factor], size * (col1 - col0), (row * self._cols + col0) * size)
            blocks = np.frombuffer(data, np.uint8).reshape(col1 - col0, side, side, 4)
            top = (row - row0) * side
            out[top : top + side] = blocks.transpose(1, 0, 2, 3).reshape(side, -1, 4)
        return out


def _write(descriptor: int, data: bytes, offset: int) -> None:
    try:
        if hasattr(os, "pwrite"):
            os.pwrite(descriptor, data, offset)
        else:  # Windows
            os.lseek(descriptor, offset, os.SEEK_SET)
            os.write(descriptor, data)
    except OSError as error:
        raise StorageError(f"the canvas cannot be written ({error.strerror}); free some disk space") from None


def _read(descriptor: int, size: int, offset: int) -> bytes:
    if hasattr(os, "pread"):
        data = os.pread(descriptor, size, offset)
    else:  # Windows
        os.lseek(descriptor, offset, os.SEEK_SET)
        data = os.read(descriptor, size)
    return data + bytes(size - len(data))  # beyond the end of the file nothing was drawn yet
