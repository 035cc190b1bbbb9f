"""Readers of poses: pairing photos with camera events, and what is checked in tags, logs and videos."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class IngestConfig:
    """Tags, logs and videos: what belongs together, what cannot be right, which pictures of a video are used."""

    fastest_m_s: float = 128.6
    """No aircraft that takes pictures flies faster over ground, m/s: 250 knots, the limit below 10,000 feet (14 CFR
    91.117(a)); small drones may fly 44.7 m/s (14 CFR 107.51(a))."""
    video_height_share: float = 0.04
    """Distance between the pictures used of a video, as a share of the height (chosen: 96 % overlap at 60 degrees)."""
    video_every_s: float = 0.5
    """Time between them where no height is known, seconds (chosen)."""
