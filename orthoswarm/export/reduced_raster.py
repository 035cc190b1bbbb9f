"""A raster at about the resolution that is asked for: its overviews are read instead of all of its pixels."""

import contextlib
from pathlib import Path
from typing import Any


class ReducedRaster(contextlib.ExitStack):
    """An open raster, and its overviews as rasters of their own.

    The overviews of our orthoimages are means of 2 x 2 pixels, so that nothing is lost against reading all pixels; they
    are opened when they are first asked for. Not for several threads at once.

    Args:
        path: the raster.

    Raises:
        RasterioError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        import rasterio

        super().__init__()
        self._path = path
        self.full = self.enter_context(rasterio.open(path))
        self._factors: list[int] = self.full.overviews(1)
        self._overviews: dict[int, Any] = {}

    def at(self, factor: float) -> tuple[Any, float]:
        """The dataset whose pixels are the largest that are at most `factor` pixels of the raster wide.

        Returns:
            The dataset, and how many of its pixels `factor` is.
        """
        import rasterio

        levels = [k for k, size in enumerate(self._factors) if size <= factor]
        if not levels:
            return self.full, factor
        level = levels[-1]
        if level not in self._overviews:
            self._overviews[level] = self.enter_context(rasterio.open(self._path, overview_level=level))
        return self._overviews[level], factor / self._factors[level]
