"""Start values without a map: headings, tilt and lens, ground scale, network of positions, segments and legs.

Robust schedules are scales c (squared sigmas) of successive solutions, from far off to near.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialConfig:
    """Start values without a map."""

    # Focal length
    default_fov_deg: float = 75.0
    """Field of view where no tag gives one, degrees: the middle of drones' cameras (chosen; not measured)."""
