"""Times: those written as text (EXIF, ISO 8601) or as numbers since 1970, and the scales of GPS and TAI."""

import calendar
import re

ZONE_UNKNOWN = "without zone, taken as UTC"  # end of the origin of a time whose zone is not known
ZONE_CONTRADICTS = "zone from GPS time, which the stated one contradicts"  # ... whose zone was stated otherwise
GPS_EPOCH_S, WEEK_S = 315_964_800.0, 604_800.0
"""Start of GPS time (1980-01-06) in epoch seconds, and a GPS week in seconds."""
GPS_MINUS_UTC_S, TAI_MINUS_UTC_S = 18.0, 37.0  # leap seconds since 2017 (IERS Bulletin C)
YEAR_2000_S = 946_684_800.0  # 2000-01-01 in epoch seconds: a clock that is earlier was never set

_WRITTEN = re.compile(
    r"\s*(\d{4})[:\-/](\d{1,2})[:\-/](\d{1,2})[T ]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d+))?)?\s*"
    r"(Z|UTC|GMT|[+-]\d{2}(?::?\d{2})?)?\s*",
    re.IGNORECASE,
)


def parse_time(value: str) -> tuple[float, bool] | None:
    """Epoch seconds of an EXIF or ISO 8601 time and whether a zone was given; without one it is read as UTC.

    None if it is not such a time, or more than that: what follows may be a zone, or the other half of the day.
    """
    match = _WRITTEN.fullmatch(value)
    if match is None:
        return None
    year, month, day, hour, minute = (int(match[i]) for i in range(1, 6))
    second = int(match[6] or 0)
    if not (1970 <= year < 2200 and 1 <= month <= 12 and 1 <= day <= 31 and hour < 25 and minute < 60 and second < 61):
        return None
    seconds = calendar.timegm((year, month, day, hour, minute, second, 0, 0, 0)) + float(f"0.{match[7] or 0}")
    if match[8] is None:
        return seconds, False
    zone = parse_offset(match[8])
    return None if zone is None else (seconds - zone, True)


def epoch_of(value: str) -> float | None:
    """Epoch seconds of a time that `parse_time` reads; None if it is none."""
    parsed = parse_time(value)
    return None if parsed is None else parsed[0]


def parse_offset(value: str) -> float | None:
    """Seconds east of UTC of "+02:00", "-0530", "+02" (ISO 8601: minutes may be left out) or "Z"; else None."""
    value = value.strip().upper()
    if value in ("Z", "UTC", "GMT"):
        return 0.0
    match = re.fullmatch(r"([+-])(\d{2})(?::?(\d{2}))?", value)
    if match is None or int(match[2]) > 14 or int(match[3] or 0) > 59:
        return None
    seconds = int(match[2]) * 3600.0 + int(match[3] or 0) * 60.0
    return -seconds if match[1] == "-" else seconds


def epoch_seconds(value: float) -> float | None:
    """Seconds since 1970 of a number of seconds, milliseconds, microseconds or nanoseconds; None beyond them.

    The scale shows in the size: seconds reach 1e10 in the year 2286, which in milliseconds was in April 1970.
    """
    return next((float(value / scale) for scale in (1.0, 1e3, 1e6, 1e9) if abs(value) / scale < 1e10), None)
