"""The paper's refiner: legs, lines, field of view (III.C), patches on the map (III.D)."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperConfig:
    """The paper's refiner. It gives no numbers for most of these; docs/method.md says what is read into it."""

    # Scale and field of view (III.C, Eq. 4)

    scale_pairs: int = 40
    """Matched pairs a vehicle, about (chosen for cost)."""

    # Patches on the map (III.D)

    patch_search_m: tuple[float, float] = (30.0, 70.0)
    """Search radius of the first and the second attempt, metres (chosen; not measured)."""
