"""Poses of pictures from a table, in a common form."""

from dataclasses import dataclass
from pathlib import Path

from orthoswarm.model.errors import InputError
from telemetry.samples.unreadable import MOST_TEXT_BYTES


@dataclass(slots=True, kw_only=True)
class PoseRow:
    """A table's values for one picture; None where it has none."""

    lat_deg: float | None = None
    lon_deg: float | None = None
    altitude_m: float | None = None
    height_m: float | None = None
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    sigma_m: float | None = None
    time_s: float | None = None
    fov_deg: float | None = None
    vehicle: str | None = None


class PoseTable(dict[str, PoseRow]):
    """Lower-case picture name (or relative path with forward slashes) -> row.

    Attributes:
        useless: number of lines that name a picture without a valid position.
        refused: number of cells that were not understood; first_refused: the first of them.
    """

    useless: int = 0
    refused: int = 0
    first_refused: str = ""

    def refuse(self, cell: str) -> None:
        """Count a cell that is not understood."""
        self.first_refused = self.first_refused or "".join(c for c in cell if c.isprintable())[:40]
        self.refused += 1


def lookup(table: PoseTable, relative: str) -> PoseRow | None:
    """The row of a picture by its path relative to the table's folder, else by its name, with or without the suffix."""
    return next((table[name] for name in names_of(relative) if name in table), None)


def names_of(relative: str) -> tuple[str, str, str]:
    """Names that a table may use for a picture at this path relative to the table's folder: path, name, stem."""
    path = relative.lower()
    name = path.rsplit("/", 1)[-1]
    return path, name, name.rsplit(".", 1)[0]


def read_text(path: Path) -> str:
    """A table's text.

    Raises:
        InputError: it is too large, or cannot be read.
    """
    try:
        if path.stat().st_size > MOST_TEXT_BYTES:
            raise InputError(f"{path.name} is larger than {MOST_TEXT_BYTES >> 20} MB; split it")
        return path.read_bytes().decode("utf-8-sig", "replace").replace("\0", "")
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check the file") from None


def pitch_by_value(table: PoseTable) -> None:
    """Convert pitch to -90 at nadir: some programs count from nadir, which the median value shows."""
    pitches = sorted(r.pitch_deg for r in table.values() if r.pitch_deg is not None)
    if pitches and pitches[len(pitches) // 2] > -45.0:
        for row in table.values():
            if row.pitch_deg is not None:
                row.pitch_deg -= 90.0
