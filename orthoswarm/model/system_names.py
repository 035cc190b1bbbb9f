"""EPSG codes of coordinate systems that files call by other names, as older programs and surveyors do."""

import re
from typing import Final

_OTHER_NAMES: Final = {
    "puwg1992": 2180, "pl1992": 2180, "uklad1992": 2180, "lambert93": 2154, "nztm": 2193, "bng": 27700, "osgb": 27700,
    "osgb36": 27700, "rdnew": 28992, "rd": 28992, "itm": 2157, "lv95": 2056, "lv03": 21781, "sweref99": 3006,
    **{f"puwg2000s{zone}": 2171 + zone for zone in range(5, 9)},
    **{f"puwg2000strefa{zone}": 2171 + zone for zone in range(5, 9)},
}  # fmt: skip
"""What EPSG's own list does not have, letters and digits alone."""
_LEAST_LETTERS: Final = 4  # shorter names fit anything


def proposed_code(name: str) -> str | None:
    """The system that a name may stand for, as "EPSG:2180 (ETRF2000-PL / CS92)"; None if no or several ones fit."""
    import pyproj
    from pyproj.database import query_crs_info
    from pyproj.enums import PJType

    wanted = _plain(name)
    code = _OTHER_NAMES.get(wanted)
    if code is not None:
        return f"EPSG:{code} ({pyproj.CRS.from_epsg(code).name})"
    if len(wanted) < _LEAST_LETTERS:
        return None
    known = query_crs_info("EPSG", [PJType.PROJECTED_CRS, PJType.GEOGRAPHIC_2D_CRS])
    fit = [info for info in known if wanted in _plain(info.name)]
    exact = [info for info in fit if _plain(info.name).endswith(wanted)] if len(fit) > 1 else fit
    return f"EPSG:{exact[0].code} ({exact[0].name})" if len(exact) == 1 else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
