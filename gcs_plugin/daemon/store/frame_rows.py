"""Pictures in the journal: their recorded poses, what was drawn of them, what became of them; and camera events."""

import json
import sqlite3
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, astuple, dataclass
from typing import Any, Final

from gcs_plugin.daemon.store.journal import Change, Journal, all_changes, packed, statements, unpacked
from orthoswarm.raster.picture_quality import PictureQuality

Whose = tuple[str, int]
"""A vehicle and the number of its sortie."""
POSE_KEYS: Final = ("epsg", "homography", "k1", "k2", "cx", "cy", "k3", "ground_z_m")
"""What `/api/frames?poses=1` tells of a line of frames.jsonl."""
Exposed = tuple[str, int, float, float | None, float | None]
"""Vehicle, number, UTC epoch seconds, latitude and longitude in degrees (None where the camera had no position)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRow:
    """A picture.

    Attributes:
        time_s, arrived_s: when it was taken, None if unknown, and when it came; UTC epoch seconds.
        path: of its file in the store. size: columns and rows. pose: `PostedPose.values`, with `origin`.
        stage: realtime, coarse, fine or rejected. sigma_m: its error estimate. reason: why it was rejected.
        placed: where it was drawn, see `Drawn`; empty before.
        thumbnail, quality: of a drawn one, where they were asked for; see `Drawn`.
    """

    seq: int
    vehicle: str
    image: str
    sortie: int
    time_s: float | None
    arrived_s: float
    path: str
    size: tuple[int, int]
    pose: dict[str, Any]
    drawn: bool
    stage: str
    sigma_m: float | None
    reason: str | None
    placed: dict[str, Any]
    thumbnail: bytes | None = None
    quality: PictureQuality | None = None


def _frame(row: sqlite3.Row, **more: Any) -> FrameRow:
    return FrameRow(
        seq=row["seq"], vehicle=unpacked(row["vehicle"]), image=unpacked(row["image"]), sortie=row["sortie"],
        time_s=row["time"], arrived_s=row["arrived"], path=row["path"], size=(row["width"], row["height"]),
        pose=json.loads(row["pose"]), drawn=bool(row["drawn"]), stage=row["stage"], sigma_m=row["sigma"],
        reason=row["reason"], placed=json.loads(row["camera"] or "{}"), **more,
    )  # fmt: skip


def _frames(journal: Journal, rest: str, values: Any = ()) -> list[FrameRow]:
    return [_frame(row) for row in journal.rows(f"SELECT * FROM frames {rest}", values)]


# -- one picture ------------------------------------------------------------------------------------------------------


def frame_by_key(journal: Journal, key: bytes) -> tuple[int, str] | None:
    """Number and path of a picture by the key of its name, None if it never came."""
    row = journal.one("SELECT seq, path FROM frames WHERE key = ?", (key,))
    return None if row is None else (int(row["seq"]), row["path"])


def frame_path(journal: Journal, seq: int) -> str | None:
    """The path of a picture by its number."""
    row = journal.one("SELECT path FROM frames WHERE seq = ?", (seq,)) if 0 <= seq < 2**63 else None
    return None if row is None else str(row["path"])


def frame_number(journal: Journal, vehicle: str, image: str) -> int | None:
    """The number of a picture by its name."""
    row = journal.one("SELECT seq FROM frames WHERE vehicle = ? AND image = ?", (packed(vehicle), packed(image)))
    return None if row is None else int(row["seq"])


def pose_near(journal: Journal, vehicle: str, time_s: float) -> dict[str, Any]:
    """The pose of a vehicle's picture nearest in time; empty if it has none."""
    row = journal.one(
        "SELECT pose FROM frames WHERE vehicle = ? AND time IS NOT NULL ORDER BY ABS(time - ?)",
        (packed(vehicle), time_s),
    )
    return {} if row is None else dict(json.loads(row["pose"]))


# -- several ----------------------------------------------------------------------------------------------------------


def all_frames(journal: Journal) -> list[FrameRow]:
    """All pictures by vehicle and time."""
    return _frames(journal, "ORDER BY vehicle, time, seq")


def arrived_frames(
    journal: Journal, vehicle: str | None = None, since_s: float | None = None, limit: int | None = None
) -> list[FrameRow]:
    """Pictures in the order of arrival; `since_s`: taken then or later."""
    where, values = ["1"], list[Any]()
    if vehicle is not None:
        where.append("vehicle = ?")
        values.append(packed(vehicle))
    if since_s is not None:
        where.append("time >= ?")
        values.append(since_s)
    rest = f"WHERE {' AND '.join(where)} ORDER BY seq LIMIT ?"
    return _frames(journal, rest, [*values, -1 if limit is None else limit])


def newest_frames(journal: Journal) -> dict[int, FrameRow]:
    """The newest picture of each vehicle, by its number."""
    found = _frames(journal, "WHERE seq IN (SELECT MAX(seq) FROM frames GROUP BY vehicle)")
    return {row.seq: row for row in found}


def sortie_frames(journal: Journal, vehicle: str, sortie: int | None) -> list[FrameRow]:
    """A sortie's pictures in order of time, with thumbnails of the drawn ones.

    Rejected ones are left out, but for those of a receiver that had no news: later fixes may tell their places.
    """
    rows = journal.rows(
        "SELECT frames.*, thumbnails.rgb FROM frames LEFT JOIN thumbnails USING (seq)"
        " WHERE vehicle = ? AND sortie = ? AND (reason IS NULL OR json_extract(pose, '$.held_m') > 0)"
        " ORDER BY time, seq",
        (packed(vehicle), sortie),
    )
    return [_frame(row, thumbnail=row["rgb"]) for row in rows]


def drawn_frames(journal: Journal, after: int, most: int) -> list[FrameRow]:
    """Pictures on the real-time layer with a higher number, in the order of arrival, with their quality."""
    rows = journal.rows(
        "SELECT frames.*, sharpness, contrast, flat_share, saturated_share FROM frames"
        " LEFT JOIN qualities USING (seq) WHERE drawn = 1 AND reason IS NULL AND seq > ? ORDER BY seq LIMIT ?",
        (after, most),
    )
    return [_frame(row, quality=_quality(row)) for row in rows]


def _quality(row: sqlite3.Row) -> PictureQuality | None:
    if row["sharpness"] is None:
        return None
    return PictureQuality(row["sharpness"], row["contrast"], row["flat_share"], row["saturated_share"])


def undrawn_frames(journal: Journal, most: int) -> list[FrameRow]:
    """Pictures that are to be drawn, in the order of arrival."""
    return _frames(journal, "WHERE drawn = 0 ORDER BY seq LIMIT ?", (most,))


def unplaced_frames(journal: Journal, most: int) -> list[FrameRow]:
    """Pictures on the real-time layer alone, of sorties that are not complete, the newest first."""
    return _frames(
        journal,
        "WHERE stage = 'realtime' AND reason IS NULL"
        " AND NOT EXISTS (SELECT 1 FROM completions c WHERE c.vehicle = frames.vehicle"
        " AND c.sortie = frames.sortie) ORDER BY seq DESC LIMIT ?",
        (most,),
    )


def rejected_frames(journal: Journal) -> list[tuple[str, float, str]]:
    """Vehicle, time and image of pictures that cannot be used and whose time is known."""
    rows = journal.rows("SELECT vehicle, image, time FROM frames WHERE reason IS NOT NULL AND time NOT NULL")
    return [(unpacked(row["vehicle"]), float(row["time"]), unpacked(row["image"])) for row in rows]


def dated_images(journal: Journal, vehicle: str) -> list[tuple[str, float]]:
    """Names and times of a vehicle's pictures whose time is known."""
    rows = journal.rows("SELECT image, time FROM frames WHERE vehicle = ? AND time IS NOT NULL", (packed(vehicle),))
    return [(unpacked(row["image"]), row["time"]) for row in rows]


def poses_after(journal: Journal, seq: int) -> list[tuple[int, dict[str, Any]]]:
    """Numbers and poses of pictures with a higher number, in the order of arrival."""
    rows = journal.rows("SELECT seq, pose FROM frames WHERE seq > ? ORDER BY seq", (seq,))
    return [(int(row["seq"]), json.loads(row["pose"])) for row in rows]


def last_arrivals(journal: Journal, vehicle: str, sortie: int | None, most: int) -> list[float]:
    """When the newest pictures of a sortie came, UTC epoch seconds, the newest first."""
    rows = journal.rows(
        "SELECT arrived FROM frames WHERE vehicle = ? AND sortie = ? ORDER BY seq DESC LIMIT ?",
        (packed(vehicle), sortie, most),
    )
    return [float(row["arrived"]) for row in rows]


# -- counts -----------------------------------------------------------------------------------------------------------


def photographed_sorties(journal: Journal) -> list[Whose]:
    """The sorties that have pictures, in the order of their first ones."""
    rows = journal.rows("SELECT vehicle, sortie FROM frames GROUP BY vehicle, sortie ORDER BY MIN(seq)")
    return [(unpacked(row["vehicle"]), int(row["sortie"])) for row in rows]


def stage_counts(journal: Journal) -> dict[str, int]:
    """How many pictures there are, by stage."""
    return {row["stage"]: row["n"] for row in journal.rows("SELECT stage, COUNT(*) AS n FROM frames GROUP BY stage")}


def sortie_is_drawn(journal: Journal, vehicle: str, sortie: int | None) -> bool:
    """Whether no picture of a sortie waits to be drawn."""
    query = "SELECT 1 FROM frames WHERE drawn = 0 AND vehicle = ? AND sortie IS ? LIMIT 1"
    return journal.one(query, (packed(vehicle), sortie)) is None


def drawn_in_sortie(journal: Journal, whose: Whose) -> int:
    """How many pictures of a sortie are drawn."""
    query = "SELECT COUNT(*) AS n FROM frames WHERE drawn = 1 AND vehicle = ? AND sortie = ?"
    return int(journal.rows(query, (packed(whose[0]), whose[1]))[0]["n"])


def undrawn_before(journal: Journal, arrived_s: float) -> int:
    """How many pictures came before a time (UTC epoch seconds) and wait to be drawn."""
    return int(journal.rows("SELECT COUNT(*) AS n FROM frames WHERE drawn = 0 AND arrived < ?", (arrived_s,))[0]["n"])


def last_drawn_arrival(journal: Journal) -> float | None:
    """When the newest drawn picture came, UTC epoch seconds."""
    last: float | None = journal.rows("SELECT MAX(arrived) AS last FROM frames WHERE drawn = 1")[0]["last"]
    return last


# Jobs of journals that an earlier version wrote have no `newest_seq`; their times stand in for it. Else times decide
# nothing: a clock that was set back would hide what came since.
_LATE: Final = """
SELECT COUNT(*) AS late FROM frames WHERE vehicle = :vehicle AND sortie = :sortie AND reason IS NULL
    AND seq > COALESCE((SELECT MAX(COALESCE(json_extract(detail, '$.newest_seq'), (SELECT MAX(seq) FROM frames
            WHERE arrived <= COALESCE(json_extract(jobs.detail, '$.refine_started_s'), jobs.started)))) FROM jobs
        WHERE kind = 'refine' AND vehicle = :vehicle AND sortie = :sortie AND id != :job), 0)
    AND (EXISTS (SELECT 1 FROM completions WHERE vehicle = :vehicle AND sortie = :sortie)
        OR EXISTS (SELECT 1 FROM jobs WHERE kind = 'refine' AND vehicle = :vehicle AND sortie = :sortie
            AND json_extract(detail, '$.trigger') = 'lost'))
"""


def newest_seq(journal: Journal) -> int:
    """The number of the newest frame of all, 0 without one; a refinement notes it as `newest_seq` when it begins."""
    return int(journal.rows("SELECT COALESCE(MAX(seq), 0) AS newest FROM frames")[0]["newest"])


def late_frames(journal: Journal, vehicle: str, sortie: int | None, job: int = 0) -> int:
    """Number of frames of a sortie that its last refinement (other than the job's) did not use; 0 while it is flown."""
    row = journal.rows(_LATE, {"vehicle": packed(vehicle), "sortie": sortie, "job": job})[0]
    return int(row["late"])


# -- changes ----------------------------------------------------------------------------------------------------------


def add_frame(
    key: bytes,
    vehicle: str,
    image: str,
    *,
    time_s: float | None,
    path: str,
    size: tuple[int, int],
    pose: Mapping[str, Any],
) -> Callable[[sqlite3.Connection], tuple[int, bool]]:
    """The change that adds a frame to the vehicle's present sortie.

    Its result is the frame's number and whether it is new.
    """
    name, arrived = packed(vehicle), time.time()
    row = (key, name, packed(image), time_s, arrived, path, size[0], size[1], json.dumps(pose), name)

    def change(db: sqlite3.Connection) -> tuple[int, bool]:
        db.execute("INSERT OR IGNORE INTO vehicles (id) VALUES (?)", (name,))
        cursor = db.execute(
            "INSERT OR IGNORE INTO frames (key, vehicle, image, time, arrived, path, width, height, pose, sortie)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, (SELECT sortie FROM vehicles WHERE id = ?))",
            row,
        )
        new = cursor.rowcount == 1
        number = db.execute("SELECT seq FROM frames WHERE key = ?", (key,)).fetchone()[0]
        return int(number), new

    return change


@dataclass(frozen=True, slots=True)
class Drawn:
    """A frame after drawing.

    Attributes:
        reason: why it was rejected, None if it was not. sigma_m: its error estimate, metres.
        thumbnail: bytes of uint8 (12, 16, 3), for balancing gains; None for a picture that was not read.
        quality: its sharpness and damage, None for a picture that was not read or is too small.
        placed: `placed_by` (receiver or map), `placed_after_s` (seconds from arrival to the map), `sigma_m`, and
            `pose`: of its line in frames.jsonl what `POSE_KEYS` names.
    """

    seq: int
    reason: str | None
    sigma_m: float | None
    _: KW_ONLY
    thumbnail: bytes | None = None
    quality: PictureQuality | None = None
    placed: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class DrawnAgain:
    """A drawn frame that was drawn again elsewhere: its error estimate in metres, and `placed` as of `Drawn`."""

    seq: int
    sigma_m: float
    placed: dict[str, Any]


def frames_moved(results: Sequence[DrawnAgain]) -> Change:
    """The change that records where frames were drawn again; what was of their first drawing is kept as `first`."""
    return statements(
        "UPDATE frames SET camera = json_set(?, '$.first', json(coalesce(json_extract(camera, '$.first'), camera))),"
        " sigma = CASE WHEN stage IN ('coarse', 'fine') THEN sigma ELSE ? END WHERE seq = ?",
        [(json.dumps(m.placed), m.sigma_m, m.seq) for m in results],
    )


def frames_drawn(results: Iterable[Drawn]) -> Change:
    """The change that records frames as drawn in real time; frames refined meanwhile are left unchanged."""
    done = list(results)
    rows = [
        (d.reason, "rejected" if d.reason else "realtime", d.sigma_m, d.placed and json.dumps(d.placed), d.seq)
        for d in done
    ]
    thumbnails = [(d.seq, d.thumbnail) for d in done if d.thumbnail is not None]
    qualities = [(d.seq, *astuple(d.quality)) for d in done if d.quality is not None]

    return all_changes(
        statements(
            "UPDATE frames SET drawn = 1, reason = ?, stage = CASE WHEN stage IN ('coarse', 'fine') THEN stage"
            " ELSE ? END, sigma = CASE WHEN stage IN ('coarse', 'fine') THEN sigma ELSE ? END, camera = ?"
            " WHERE seq = ?",
            rows,
        ),
        statements("INSERT OR REPLACE INTO thumbnails VALUES (?, ?)", thumbnails),
        statements("INSERT OR REPLACE INTO qualities VALUES (?, ?, ?, ?, ?)", qualities),
    )


def exposures_added(rows: Sequence[Exposed]) -> Change:
    """The change that adds events; those that are known stay."""
    values = [(packed(vehicle), *rest) for vehicle, *rest in rows]
    return statements("INSERT OR IGNORE INTO exposures VALUES (?, ?, ?, ?, ?)", values)


def all_exposures(journal: Journal) -> list[Exposed]:
    """All events, by vehicle and time."""
    rows = journal.rows("SELECT vehicle, number, time, lat, lon FROM exposures ORDER BY vehicle, time")
    return [(unpacked(r["vehicle"]), int(r["number"]), float(r["time"]), r["lat"], r["lon"]) for r in rows]


def exposure_times(journal: Journal, vehicle: str) -> list[tuple[int, float]]:
    """Numbers and times of a vehicle's events."""
    rows = journal.rows("SELECT number, time FROM exposures WHERE vehicle = ?", (packed(vehicle),))
    return [(row["number"], row["time"]) for row in rows]


def exposure_place(journal: Journal, vehicle: str, number: int, time_s: float) -> tuple[float, float] | None:
    """Latitude and longitude of an event (of those with its number the nearest in time), None without a position."""
    row = journal.one(
        "SELECT lat, lon FROM exposures WHERE vehicle = ? AND number = ? AND lat IS NOT NULL ORDER BY ABS(time - ?)",
        (packed(vehicle), number, time_s),
    )
    return None if row is None else (float(row["lat"]), float(row["lon"]))
