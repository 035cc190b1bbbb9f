"""Readers of poses: pairing photos with camera events, and what is checked in tags, logs and videos."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class PairingConfig:
    """Photos and camera events, two recordings of one sequence of exposures."""

    certain: float = 1.0 - 1e-4
    """Probability from which on a pairing counts as certain: the model's odds of losses are estimates (chosen;
    benchmarks.accuracy.photo_pairing finds no wrong pairing without a mark at it)."""
    least_probability: float = 0.02
    """Events that a photo has with less probability are not listed as its alternatives (chosen)."""
    other_clock_intervals: float = 10.0
    """Two clocks that differ by more usual intervals between exposures are two ways to pair a flight (chosen: an even
    rhythm fits some intervals off, too, which the sigma covers; other legs and flights are tens of intervals away)."""
    same_exposure_s: float = 0.12
    """Camera events closer than this are one exposure that was recorded twice, seconds; at most 0.35 of the usual
    interval (CAMERA_TRIGGER and CAMERA_IMAGE_CAPTURED of one exposure are up to 0.1 s apart)."""
    interval_margin: float = 0.9
    """The camera takes no two exposures closer than this share of the shortest interval in the recordings (chosen)."""
    negligible_log_odds: float = 16.0
    """Clocks whose odds against the best one are lower than exp(-16), 1e-7, are left out of the sum (chosen)."""
    most_drift: float = 1.2e-3
    """Largest drift between the two clocks, seconds a second: quartz clocks of cameras stay below 1e-4, and a tenfold
    margin for poor ones (chosen)."""
    first_jitter_s: float = 0.08
    """One sigma of the time between trigger and exposure at which the search begins, seconds (chosen)."""
    jitters_s: tuple[float, ...] = (0.02, 0.03, 0.045, 0.07, 0.1, 0.16)
    """The sigmas that are then tried, seconds (chosen)."""
    missing_odds: tuple[float, ...] = (0.03, 0.06, 0.12, 0.2, 0.35)
    """Odds of a missing photo, and of a missing event, that are tried; not less than 0.03, since a flight without any
    loss does not show that there can be none (chosen)."""
    missing_at_end: float = 0.5
    """Odds of a missing exposure before the first or after the last pair: logs begin earlier (chosen)."""
    false_time: float = 1e-5
    """Probability of an exposure that is closer to another than the camera's shortest interval (chosen)."""
    clock_candidates: int = 24
    """Maxima of the correlation of the two recordings whose clocks are examined (chosen)."""
    most_windows: int = 64
    """Windows of possible clocks over which the probabilities are summed at most (chosen)."""
    window_drift_s: float = 0.16
    """Half width in drift of such a window, as the shift of the first and last exposure, seconds (chosen)."""
    most_bins: int = 1 << 19
    """Bins of the correlation at most: longer recordings get wider bins (chosen: 8 MB)."""
    most_drifts: int = 81
    """Drifts that are correlated at most (chosen)."""
    pictures_from_s: float = 0.5
    """Resolution of the camera's times, seconds, from which on pictures decide what times leave open (chosen)."""
    least_agreement: float = 0.9
    """A pairing by pictures counts if it keeps this share of the pairs that the times alone give (chosen)."""
    least_matched: float = 0.6
    """Share of photos or events with a partner; a clock that leaves more unpaired is not the right one (chosen)."""
    most_chain_photos: int = 24
    """Longest chain of photos whose motion is added up: errors of relief and scale grow along it (chosen)."""
    phase_step_s: float = 0.06
    """Step of the hypotheses for when in its second a chain's first photo was taken, seconds (chosen)."""
    chain_scales: tuple[float, ...] = (0.96, 1.0, 1.04)
    """Scale of a chain over that of the flight: the height above ground varies (chosen)."""
    least_speed_m_s: float = 0.3
    """Slowest speed by which errors of position become errors of time, m/s (chosen)."""
    false_match: float = 1e-3
    """Probability that the motion between two pictures is wrong although it looks right (chosen)."""
    same_exposure_share: float = 0.35
    """A photo nearer to an event than this share of the usual distance between events is that exposure (chosen)."""
    jump_windows: int = 4
    """Parts of a flight whose clocks are compared to find whether the camera's clock was set in between (chosen)."""
    jump_least_photos: int = 6
    """Photos of such a part at least, and photos that only its clock gives an event (chosen: fewer fit by accident)."""
    least_jump_s: float = 0.6
    """Clocks of two parts that differ by more than this and the largest drift are two settings, seconds (chosen: more
    than half of the whole seconds that many cameras write)."""
    most_tilt_deg: float = 60.0
    """Pictures that look farther from nadir than this tell nothing of the distance flown, degrees (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IngestConfig:
    """Tags, logs and videos: what belongs together, what cannot be right, which pictures of a video are used."""

    copied_least: int = 3
    """Two folders with so many photos in common may be one and its copy (chosen)."""
    log_least_share: float = 0.5
    """A log belongs to photos if this share of the shorter of both is paired (chosen)."""
    log_same_exposure_s: float = 1.0
    """Exposures of two logs at most so far apart in time (and 3 m) are one exposure, seconds (chosen)."""
    log_same_fit: float = from_zero(0.05)
    """Two logs whose misfits to photos differ by no more than this fit equally well: a share of photos without event,
    or of `event_far_m` (chosen)."""
    event_far_m: float = 60.0
    """Photos whose own position is farther than this from their camera event are reported, metres (chosen)."""
    track_far_m: float = 10.0
    """Photos nearer than this to a log's track at their times do not contradict it, metres (chosen: the errors of two
    receivers, and the way flown in half a second)."""
    track_far_times: float = 5.0
    """Photos farther from it than so many times their median distance contradict it (chosen)."""
    bus_same_vehicle_m: float = 20.0
    """A CAN log belongs to the autopilot's log whose track is within this distance (median), metres (chosen)."""
    bus_least_common: int = 10
    """Positions at common times that this takes (chosen)."""
    clock_jump_s: float = 60.0
    """A step back in the photos' times by more than this is a jump of the camera's clock, seconds (chosen)."""
    turning_rate_hz: float = 4.0
    """Pictures a second of a video that are compared with a log's turns (chosen)."""
    turning_width_px: int = 320
    """Width at which they are compared, pixels (chosen)."""
    turning_longest_s: float = 600.0
    """Longest part of a video that is compared, seconds (chosen)."""
    turning_margin: float = 0.1
    """The turns of a video decide between two clocks, or two logs, if their correlations differ by more (chosen)."""
    nadir_within_deg: float = 45.0
    """A gimbal roll near 180 degrees is a turned yaw if the camera looks within this of nadir, degrees (chosen)."""
    outlying_position_m: float = 100.0
    """A photo farther than this from those before and after has a wrong position, metres (and 15 steps; chosen)."""
    fastest_m_s: float = 128.6
    """No aircraft that takes pictures flies faster over ground, m/s: 250 knots, the limit below 10,000 feet (14 CFR
    91.117(a)); small drones may fly 44.7 m/s (14 CFR 107.51(a))."""
    time_resolution_s: float = 1.0
    """Times of positions may be off by this, seconds: many are written in whole seconds."""
    wild_most_share: float = 0.1
    """Positions that cannot be reached are wild up to this share of all; more are another flight (chosen)."""
    wild_most_pieces: int = 10_000
    """A track that cannot be flown at more places than this has wrong times, not wild positions (chosen)."""
    longest_repeat_s: float = 30.0
    """A receiver may repeat a fix for so long, during which it flies on, seconds (chosen)."""
    far_share: float = 0.2
    """Up to this share of photos far from their camera events have wrong positions; more are of another flight
    (chosen)."""
    most_zone_s: float = 54_000.0
    """No time zone explains a larger offset of a camera's clock, seconds: 14 hours (IANA), and one for its error."""
    low_share: float = 0.4
    """A few photos lower than this share of the usual height are reported: takeoff, landing, inspection (chosen)."""
    from_horizon_deg: float = -25.0
    """Pitches below this are counted from the horizon, not from nadir, degrees: mapping cameras look down (chosen)."""
    least_height_m: float = 1.0
    """Recorded heights below this were never filled in, metres (chosen)."""
    least_flown_height_m: float = 5.0
    """A video whose heights reach this was recorded with heights: those near zero at its ends are true, metres
    (chosen)."""
    most_height_m: float = 12_000.0
    """Recorded heights above this are not heights above ground, metres (chosen)."""
    motion_least_inliers: int = 25
    """Corners that the motion between two pictures takes at least (chosen)."""
    motion_ratio: float = 0.8
    """Ratio test of their matches (Lowe 2004)."""
    motion_most_turn_rad: float = 0.4
    """Two pictures that turn by more are not on one straight leg, radians (chosen)."""
    contradiction_m: float = 500.0
    """A table that puts a photo so far from its tags, or from another table, contradicts them, metres (chosen: more
    than receivers err by; a wrong hemisphere, coordinate system or table does that)."""
    yaw_pairs_a_leg: int = 3
    """Pairs of pictures by which the recorded yaw of a leg is checked (chosen)."""
    yaw_least_step_m: float = 1.0
    """Distance flown between such pictures at least, metres (chosen: receivers' noise)."""
    video_height_share: float = 0.04
    """Distance between the pictures used of a video, as a share of the height (chosen: 96 % overlap at 60 degrees)."""
    video_every_s: float = 0.5
    """Time between them where no height is known, seconds (chosen)."""
    video_early: float = 0.8
    """From this share of that distance on, pictures are candidates, of which the sharpest is used (chosen)."""
    video_late: float = 1.2
    """To this share (chosen)."""
    video_candidates: int = 6
    """Candidates at most (chosen: memory)."""
    zoom_step: float = 0.03
    """Natural logarithm of the field of view's change from which on a video's lens counts as another (chosen)."""
    restart_s: float = 1.0
    """A stream whose decoding times go back by more than this starts its clock again, seconds: within a recording they
    never do (chosen, above what containers round)."""
    subtitle_restart_s: float = 5.0
    """Subtitles whose times go back by more than this are those of another recording, seconds (chosen: blocks that are
    out of order are neighbours)."""
    subtitle_excess_s: float = 3.0
    """Subtitles that end later than their video by more than this are of another length, seconds (chosen: the last
    block of a second may go on for a second or two)."""
    square_within: float = 0.01
    """Pixels of a video whose width and height differ by no more than this share count as square (chosen)."""
    most_aspect: float = 4.0
    """A ratio of a pixel's sides beyond this is damage (chosen: anamorphic lenses have 2, DV has 16:11)."""
    held_at_ends_s: float = from_zero(1.0)
    """Metadata with times of its own counts this long before its first and after its last value, seconds (chosen)."""
