"""The parameters of a data set: presets, kinds of noise, and every single value."""

from dataclasses import dataclass, field, replace
from typing import Any

from orthoswarm.model.errors import InputError
from orthoswarm.twin.flights import FlightDeviations, FlightPlan, Noise

_HARD = Noise(
    heading_bias_deg=3.0, tilt_bias_deg=1.0, angle_deg=0.07, outlier_share=0.02, lag_s=(0.1, 0.5), height_m=0.15,
    height_offset_m=1.0,
)  # fmt: skip
NOISES: dict[str, Noise] = {
    "none": Noise(position_m=0.0, drift_per_photo_m=0.0),
    "paper": Noise(),
    "hard": _HARD,
    "drift": Noise(position_m=0.4, drift_per_photo_m=0.0, follows_plan=True, height_m=0.1),
    "wind": _HARD,
    "curves": _HARD,
}
"""No noise; the paper's; harder than the paper's; drift of a receiver that the autopilot follows; the hard one in
12 m/s of wind (crab angles, uneven speed); the hard one along arcs of 50 m radius."""
_MOTIONS: dict[str, dict[str, float]] = {
    "drift": {"drift_m": 18.0},
    "wind": {"wind_m_s": 12.0, "track_m": 0.8, "attitude_deg": 2.4},
    "curves": {"curve_radius_m": 50.0},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinSpec:
    """All parameters of a data set; equal parameters give equal files."""

    preset: str = "debris"  # name of the preset that it is based on
    seed: int = 1  # of all random numbers
    disaster: str = "debris"  # none, debris, water, haze, all three of them, or collapse (of houses)
    noise_name: str = "paper"  # kind of noise
    noise: Noise = field(default_factory=Noise)  # its values
    plan: FlightPlan = field(default_factory=FlightPlan)  # the flight
    motion: FlightDeviations = field(default_factory=FlightDeviations)  # how calmly it is flown
    relief_m: float = 0.0  # ground relief, +- metres (procedural city only)
    follow_ground: bool = False  # legs keep their height above the bare ground; else they are level
    lens_k: tuple[float, float] = (0.0, 0.0)  # true radial distortion k1, k2 of all lenses
    lean: float | None = None  # relief displacement in the map, metres per metre of height
    lean_deg: float | None = None  # its azimuth; None: random
    map_gsd_m: float = 0.4  # pixel of the basemap
    reference_gsd_m: float = 0.3  # of the reference
    lat_deg: float = 30.57  # where the procedural city lies; lon_deg
    lon_deg: float = 103.2
    quality: int = 92  # of the JPEGs
    rays: int = 2  # rays along the side of a pixel; 2 gives smooth edges, 1 is four times faster
    every: int = 1  # render only every n-th picture of each vehicle (records and truth stay those of the full flight)
    # orthoimage and surface model of a real place instead of the city, None for the city
    ground: tuple[str, str, str] | None = None
    margin_m: float = 290.0  # ground beyond the outermost legs
    cars: float = 0.5  # share of the parking places with a car


_TINY = FlightPlan(
    columns=2, photos=20, legs=2, spacing_m=12.0, leg_spacing_m=80.0, width=320, height=240, height_m=90.0
)
PRESETS: dict[str, TwinSpec] = {
    "tiny": TwinSpec(preset="tiny", disaster="none", plan=_TINY, margin_m=170.0),
    "debris": TwinSpec(preset="debris", disaster="debris"),
    "water": TwinSpec(preset="water", disaster="water"),
    "haze": TwinSpec(preset="haze", disaster="haze"),
    "clear": TwinSpec(preset="clear", disaster="none"),
    # 96 x 339 pictures over 6.35 square kilometres, as in the paper's scaling experiment
    "full": TwinSpec(
        preset="full", disaster="all", rays=1,
        plan=FlightPlan(columns=12, rows=8, photos=339, legs=4, spacing_m=4.5, leg_spacing_m=48.0, speed_m_s=9.0),
    ),
}  # fmt: skip


def spec(preset: str, *, seed: int = 1, noise: str = "paper", **changes: Any) -> TwinSpec:
    """A preset with a seed, a kind of noise, and further fields of TwinSpec replaced.

    Raises InputError: for a preset or a kind of noise that does not exist.
    """
    if preset not in PRESETS:
        raise InputError(f"there is no preset '{preset}'; choose one of: {', '.join(PRESETS)}")
    if noise not in NOISES:
        raise InputError(f"there is no noise '{noise}'; choose one of: {', '.join(NOISES)}")
    base = PRESETS[preset]
    motion = replace(base.motion, **_MOTIONS.get(noise, {}))
    return replace(base, **{"seed": seed, "noise_name": noise, "noise": NOISES[noise], "motion": motion, **changes})
