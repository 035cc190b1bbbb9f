"""Pictures that come after their vehicle was refined, resected by their neighbours.

Pixels are those of a picture that was reduced to the working width.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LateConfig:
    """Pictures that come after their vehicle was refined."""

    neighbours: int = 4
    """Refined pictures with which a late one is compared, nearest first (chosen for its time)."""
    work_width_px: int = 640
    """Columns in which pictures are compared (chosen for its time)."""
    corners: int = 300
    """Most corners of a late picture that are followed into each neighbour (chosen for its time)."""
    corner_quality: float = 0.005
    """Least corner measure as a share of the best one (chosen; not measured)."""
    corner_distance_px: float = 8.0
    """Least distance of corners, pixels (chosen: spread matters more than number)."""
    border_px: int = 15
    """Side of the square by which the overlap is eroded before corners are chosen, pixels (chosen)."""
    flow_window_px: int = 21
    """Side of the window of the Lucas-Kanade flow, pixels (chosen; OpenCV's default)."""
    flow_levels: int = 4
    """Levels of its pyramid: about 100 pixels of error of the start (chosen)."""
    flow_back_px: float = 0.7
    """A corner that does not come back this near when it is followed both ways is dropped, pixels (chosen)."""
    fewest: int = 25
    """Fewest points that must agree with the resection (chosen; not measured) ..."""
    least_share: float = 0.4
    """... and the least share of those found (chosen; not measured)."""
    agrees_px: float = 1.5
    """Points this near to where the resection puts them agree, pixels (chosen; not measured)."""
    position_sigma_m: float = 5.0
    """Sigma of the start's position, an axis, metres: loose, it holds only what the points do not determine
    (chosen)."""
    attitude_sigma_rad: float = 0.05
    """Sigma of the start's attitude, radians: 3 degrees, loose like that of the position (chosen)."""
    corner_height_m: float = 0.5
    """How far corners stand above the terrain that they are taken to lie on, all alike, metres (measured: 0.1 to
    0.5)."""
    least_noise_px: float = 0.1
    """Least noise of a followed corner, pixels, in the sigma that is stated (chosen)."""
    scales_px: tuple[float, float, float, float, float, float] = (20.0, 8.0, 3.0, 1.5, 1.0, 1.0)
    """Robust scales of the resection, pixels, one after the other (chosen; not measured)."""
    rounds: int = 3
    """Gauss-Newton steps at each scale, and steps onto the terrain (chosen)."""
