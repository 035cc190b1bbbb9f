"""The paper's refiner: legs, lines, field of view (III.C), patches on the map (III.D)."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperConfig:
    """The paper's refiner. It gives no numbers for most of these; docs/method.md says what is read into it."""

    # Legs and their lines (III.C)

    leg_heading_deg: float = 20.0
    """Frames of a leg differ in heading from its mean by less, degrees (chosen; not measured)."""
    leg_photos: int = 3
    """Least photos of a leg (chosen)."""
    line_distance_m: float = 4.0
    """Photos before and after a leg belong to it within this distance of its line, metres (chosen) ..."""
    line_sigmas: float = 3.0
    """... or within so many standard deviations of its photos across the line (chosen)."""
    receiver_sigma_m: float = 3.0
    """Sigma of the bias of a receiver, an axis, metres, which no line reduces: twice `records.position_sigma_m`, since
    drift is not estimated here (chosen)."""

    # Scale and field of view (III.C, Eq. 4)

    scale_pairs: int = 40
    """Matched pairs a vehicle, about (chosen for cost)."""
    scale_pair_heights: float = 0.35
    """Wanted distance between the two photos, flying heights: about 70 % overlap (chosen)."""
    scale_pair_range_heights: tuple[float, float] = (0.05, 1.0)
    """Range of that distance, flying heights (chosen)."""
    scale_centre_share: float = 0.3
    """Matches count up to this share of the picture's height from the orthogonal centre (chosen)."""
    scale_least_shift_px: float = 2.0
    """Shorter shifts do not count, pixels (chosen; not measured)."""
    scale_matches: int = 12
    """Least matches that agree on a scale (chosen; not measured)."""
    scale_scatter: float = 0.2
    """Largest standard deviation of the shifts as a share of their mean (chosen; not measured)."""
    scale_least_pairs: int = 3
    """Least pairs that give a field of view (chosen)."""
    outlier_sigmas: float = 2.0
    """Gaussian outlier suppression keeps what lies within so many standard deviations (chosen)."""
    outlier_rounds: int = 20
    """Most rounds of it (chosen)."""
    unknown_fov_sigma_deg: float = 10.0
    """Sigma of a field of view that could not be measured, degrees (chosen)."""

    # Patches on the map (III.D)

    patch_gsd_m: tuple[float, float] = (0.3, 1.0)
    """Range of a patch's ground sampling distance, metres: what suits learned matchers (chosen)."""
    patch_most_px: int = 3_000_000
    """Most pixels of a patch; longer legs are drawn coarser (chosen for memory)."""
    patch_search_m: tuple[float, float] = (30.0, 70.0)
    """Search radius of the first and the second attempt, metres (chosen; not measured)."""
    patch_most_search_px: int = 240
    """Largest search radius, pixels (chosen for cost)."""
    patch_margin_widths: float = 1.5
    """A patch extends beyond its positions by so many ground widths of a picture (chosen)."""
    roof_distance_share: float = 0.15
    """Relief displacement is judged farther than this share of the flying height from the nadir point (chosen)."""
    roof_tolerance_m: float = 3.0
    """A match whose apparent height differs from the median by more is dropped, metres (chosen) ..."""
    roof_sigmas: float = 2.0
    """... if it also differs by more than so many standard deviations (chosen)."""

    # Cameras

    pose_rounds: int = 6
    """Most Gauss-Newton steps of the pose that reproduces a homography best (chosen)."""
    carrying_neighbours: int = 3
    """Nearest registered legs of neighbours that carry a vehicle without one (chosen)."""
    carried_sigma_m: float = 2.0
    """Least sigma of a correction carried from other legs, metres (chosen; not measured)."""
