"""Checks at the daemon's start: the workspace's lock, disk space, power cuts, the basemap."""

import contextlib
import logging
import os
import shutil
import time
from pathlib import Path
from typing import Final

from gcs_plugin.daemon.store.journal import Journal, workspace_opened
from orthoswarm.batch.workspace import Workspace
from orthoswarm.model.errors import DiskFullError, InputError, StorageError
from orthoswarm.raster.basemap import Basemap

_LOCK_S: Final = 5.0
_FREE_MB: Final = 50.0
_log = logging.getLogger(__name__)


def take_over(workspace: Path) -> Workspace:
    """Take the workspace's lock, waiting for a daemon that is just ending.

    The folder becomes accessible to its owner only, as it contains the token, pictures, and positions.

    Raises:
        InputError: another daemon holds it.
    """
    end = time.monotonic() + _LOCK_S
    while True:
        try:
            lock = Workspace(workspace)
            with contextlib.suppress(OSError):  # another user's folder, or a file system without permissions
                workspace.chmod(0o700)
            return lock
        except InputError:
            if workspace.is_file() or time.monotonic() > end:
                raise
            time.sleep(0.1)


def require_space(workspace: Path, size: int) -> None:
    """Refuse to fill the disk, while there is still room for the journal.

    Raises:
        StorageError: there is too little room.
    """
    try:
        free = shutil.disk_usage(workspace).free
    except OSError as error:
        raise StorageError(f"the workspace cannot be reached ({error.strerror}); connect its disk") from None
    if free < _FREE_MB * 1e6 + size:
        raise DiskFullError(f"the disk is nearly full ({free / 1e6:.0f} MB left); free some space")


def distrust_after_power_cut(journal: Journal) -> bool:
    """After a power cut, have the real-time layer drawn again, as its last pixels may be lost.

    Pictures and journal are synced before they are acknowledged, solution files before they are published; canvases are
    not, for speed.

    Returns:
        Whether canvases can be trusted.
    """
    boot = _boot_id()
    clean = bool(journal.fact("clean") or journal.fact("boot") in (None, boot))
    journal.write(workspace_opened(boot, trusted=clean))
    if not clean:
        _log.warning("the machine was switched off without a shutdown; the real-time layer is drawn again")
    return clean


def _boot_id() -> str:
    """Identifies this boot of the machine."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return str(round((time.time() - time.monotonic()) / 60.0)) if os.name == "nt" else ""


def open_basemap(path: Path) -> Basemap | None:
    """The basemap on the UTM grid of its own centre, for display before there is an area; None if that is unknown.

    Raises:
        InputError: it cannot be read, or lies nowhere.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.warp import transform_bounds

    from orthoswarm.model.geo import area_epsg

    if path.is_dir():
        return None
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise InputError(f"the basemap {path.name} has no coordinate system; give a georeferenced map")
            west, south, east, north = transform_bounds(raster.crs, 4326, *raster.bounds)
    except RasterioError as error:
        raise InputError(f"the basemap {path.name} cannot be read ({error}); check the file") from None
    basemap = Basemap.open(path, area_epsg([south, north], [west, east]))
    basemap.require_readable(basemap.bounds)  # check it now, not when the first vehicle completes
    return basemap
