"""What is taken as known where a picture recorded nothing, and how far records are trusted."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RecordsConfig:
    """Records: defaults and trust."""

    theta_hat_deg: float = 70.0
    """Horizontal field of view where nothing is known: below that of most drones' cameras (paper III.B)."""
    far_m: float = 20_000.0
    """A position this far from the median of its set cannot be true: no small drone flies farther."""
