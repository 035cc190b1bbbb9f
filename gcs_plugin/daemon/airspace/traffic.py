"""Other aircraft, as received by the vehicles' ADS-B receivers (MAVLink's ADSB_VEHICLE)."""

import threading
import time
from collections.abc import Callable
from typing import Any, Final

from gcs_plugin.links.mavlink import dialect

FORGET_S: Final = 30.0
"""An aircraft that nobody heard for so long is dropped; receivers repeat each second what they hear."""
_COORDINATES: Final = int(dialect.ADSB_FLAGS_VALID_COORDS)
_ALTITUDE: Final = int(dialect.ADSB_FLAGS_VALID_ALTITUDE)
_HEADING: Final = int(dialect.ADSB_FLAGS_VALID_HEADING)
_VELOCITY: Final = int(dialect.ADSB_FLAGS_VALID_VELOCITY)
_CALLSIGN: Final = int(dialect.ADSB_FLAGS_VALID_CALLSIGN)
_DEGE7: Final = 1e-7


class Traffic:
    """The recently received aircraft, each once, from any vehicle; any thread.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._heard: dict[int, tuple[float, dict[str, Any]]] = {}
        self._published: list[dict[str, Any]] = []

    def heard(self, _vehicle: Any, message: Any, _utc: float) -> None:
        """Process an ADSB_VEHICLE; one without a valid position is ignored."""
        lat, lon = message.lat * _DEGE7, message.lon * _DEGE7
        if not message.flags & _COORDINATES or abs(lat) > 90.0 or abs(lon) > 180.0:
            return
        number = int(message.ICAO_address)
        name = str(message.callsign).strip("\x00 ") if message.flags & _CALLSIGN else ""
        row = {
            "id": f"{number:06x}",
            "name": "".join(letter for letter in name if letter.isascii() and letter.isprintable()),
            "lat_deg": round(lat, 7),
            "lon_deg": round(lon, 7),
            "alt_m": round(message.altitude / 1e3, 1) if message.flags & _ALTITUDE else None,
            "heading_deg": message.heading / 100.0 if message.flags & _HEADING else None,
            "speed_m_s": message.hor_velocity / 100.0 if message.flags & _VELOCITY else None,
        }
        with self._lock:
            self._heard[number] = self._clock() - float(message.tslc), row

    def rows(self) -> list[dict[str, Any]]:
        """A row per aircraft; unknown values are None.

        Keys: `id` (ICAO address), `name` (callsign), `lat_deg`, `lon_deg`, `alt_m` (above sea level or standard
        pressure, as it sends), `heading_deg`, `speed_m_s`.
        """
        with self._lock:
            end = self._clock() - FORGET_S
            self._heard = {number: heard for number, heard in self._heard.items() if heard[0] > end}
            return [row for _, row in self._heard.values()]

    def changed(self) -> bool:
        """Whether the rows differ from those at the last call."""
        rows = self.rows()
        changed, self._published = rows != self._published, rows
        return changed
