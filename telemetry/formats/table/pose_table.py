"""Poses of pictures from a table, in a common form."""

import codecs
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import islice, takewhile
from pathlib import Path

from orthoswarm.model.errors import InputError
from orthoswarm.raster.picture_file import PICTURE_SUFFIXES
from telemetry.samples.sample import Sample
from telemetry.samples.unreadable import MOST_TEXT_BYTES

_MOST_FOLDERS = 64  # folders of a path that may be left out: more are no path


class PoseTable(dict[str, Sample]):
    """Lower-case picture name (or relative path with forward slashes) -> row."""

    useless: int = 0  # number of lines that name a picture without a valid position
    refused: int = 0  # number of cells that were not understood
    first_refused: str = ""  # the first of them
    doubt: str = ""  # what is uncertain about the datum of its positions, "" if nothing is

    def refuse(self, cell: str) -> None:
        """Count a cell that is not understood."""
        self.first_refused = self.first_refused or "".join(c for c in cell if c.isprintable())[:40]
        self.refused += 1


def lookup(table: PoseTable, relative: str) -> Sample | None:
    """The row of a picture by its path relative to the table's folder, else by its name, with or without the suffix."""
    return next((table[name] for name in names_of(relative) if name in table), None)


def names_of(relative: str) -> tuple[str, str, str]:
    """Names that a table may use for a picture at this path relative to the table's folder: path, name, stem."""
    path = relative.lower()
    name = path.rsplit("/", 1)[-1]
    return path, name, name.rsplit(".", 1)[0]


def words_of_name(words: Sequence[str]) -> int:
    """How many of a line's words are the picture's name: a name with blanks ends with its suffix."""
    return next((i for i, word in enumerate(words) if Path(word).suffix.lower() in PICTURE_SUFFIXES), 0) + 1


def as_path(name: str) -> str:
    """A picture's name or path as a table's key."""
    return name.lower().replace("\\", "/").removeprefix("./")


def leave_out_folder(table: PoseTable, pictures: Collection[str]) -> str:
    """Rename rows whose paths begin elsewhere, on another machine or in a folder above, to those of the pictures here.

    Args:
        table: no name of which is a picture's. Changed where leaving out the first folders that all rows share makes
            most of its paths those of pictures. pictures: paths relative to the table's folder.

    Returns:
        the folders that were left out, with a slash at the end; "" if nothing matched.
    """
    known = {picture.lower() for picture in pictures}
    known |= {names_of(picture)[2] for picture in pictures if "/" not in picture}
    rows = [name.split("/") for name in table]
    folders = islice(zip(*(row[:-1] for row in rows)), _MOST_FOLDERS)
    shared = sum(1 for _ in takewhile(lambda names: len(set(names)) == 1, folders))
    matches = {depth: sum("/".join(row[depth:]) in known for row in rows) for depth in range(1, shared + 1)}
    depth = max(matches, key=matches.__getitem__, default=0)  # of several the first: the longest paths
    if not matches.get(depth):
        return ""
    left_out = "/".join(rows[0][:depth]) + "/"
    _rename(table, {name: name[len(left_out) :] for name in table})
    return left_out


def take_base_names(table: PoseTable, pictures: Collection[str]) -> int:
    """Rename rows to the only picture of their file name, where no other row has it either; returns how many.

    table: no name of which is a picture's. pictures: paths relative to the table's folder.
    """
    places: dict[str, list[str]] = {}
    for picture in pictures:
        path, name, stem = names_of(picture)
        for written in {name, stem}:
            places.setdefault(written, []).append(path)
    last = {name: name.rsplit("/", 1)[-1] for name in table}
    rows = Counter(last.values())
    unique = {name: places[base][0] for name, base in last.items() if rows[base] == len(places.get(base, ())) == 1}
    _rename(table, unique)
    return len(unique)


def _rename(table: PoseTable, names: dict[str, str]) -> None:
    rows = list(table.items())
    table.clear()
    table.update((names.get(name, name), row) for name, row in rows)


def decoded(data: bytes) -> str:
    """Text of a table, or of its beginning.

    It is UTF-8, UTF-16 with its mark (a spreadsheet's "Unicode text"), or else in Windows' Western code page, in which
    names with umlauts and accents come.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace").replace("\0", "")
    try:
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(data)  # a beginning may end within a letter
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    return text.replace("\0", "")


def read_text(path: Path) -> str:
    """A table's text. Raises InputError: it is too large, or cannot be read."""
    try:
        if path.stat().st_size > MOST_TEXT_BYTES:
            raise InputError(f"{path.name} is larger than {MOST_TEXT_BYTES >> 20} MB; split it")
        return decoded(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check the file") from None


def pitch_by_value(table: PoseTable) -> None:
    """Convert pitch to -90 at nadir: some programs count from nadir, which the median value shows."""
    pitches = sorted(r.pitch_deg for r in table.values() if r.pitch_deg is not None)
    if pitches and pitches[len(pitches) // 2] > -45.0:
        for row in table.values():
            if row.pitch_deg is not None:
                row.pitch_deg -= 90.0
