"""Registration: coarse shift onto the map, tie points, links, absolute orientation, neighbours, the map's offset.

Scales named robust are those of the Geman-McClure kernel, squared, of normalised residuals.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig:
    """Registration onto the map and onto neighbours."""

    # Coarse registration: mosaics of some consecutive pictures (strips) correlated with the map
    strip_pictures: int = 25
    """Pictures of a strip in which corners are followed (chosen; not measured)."""
    strip_pictures_sparse: int = 3
    """Pictures of a strip of photos that are matched in pairs: some hundred metres of ground (chosen; not measured)."""
    strip_across_px: float = 150.0
    """Width of a picture in a strip, pixels (chosen for cost)."""
    strip_gsd_m: tuple[float, float] = (0.2, 2.5)
    """Limits of a strip's ground pixel, metres (chosen)."""
    strip_most_px: int = 4_000_000
    """Larger strips are not correlated, pixels (chosen for memory)."""
    strip_farthest_heights: float = 4.0
    """A picture whose corners lie farther from its nadir than so many flying heights and the next field is left out of
    a strip: it shows the horizon (chosen)."""
    strip_farthest_m: float = 50.0
    """... and this, metres (chosen)."""
    strip_map_share: float = 0.1
    """Least share of a strip's search area that the map covers (chosen; not measured)."""
    strip_blur_px: float = 0.7
    """Sigma of the blur before the gradients, pixels (chosen; not measured)."""
    strip_fewest_edges: int = 400
    """Fewer pixels with an orientation, in the strip or on the map, show nothing (chosen; not measured)."""
    strip_border_px: int = 5
    """Side of the square by which the valid part is eroded: gradients at its edge are artefacts (chosen)."""
    energy_share: float = 0.05
    """Shifts under which the map has less energy than this share of the largest count as having it: a correlation over
    nothing is not a peak (chosen; not measured)."""
    peak_apart_px: int = 4
    """Correlations within this distance, pixels, belong to the same peak (chosen)."""
    coarse_reach_m: tuple[float, float] = (60.0, 150.0)
    """How far strips are searched, metres: first, and where that is refuted (chosen: receivers without corrections are
    within the first)."""
    consensus_m: float = 6.0
    """Strips whose shifts lie this near to a line over the pictures agree, metres (chosen; not measured)."""
    consensus_slope_m: float = 0.5
    """Steepest such line, metres a picture: a receiver's drift (chosen; not measured)."""
    consensus_least_weight: float = 0.02
    """Least weight of a strip (1 minus the ratio of its second peak to its first; chosen)."""
    stack_blur_px: float = 2.0
    """Sigma of the blur of the correlations that are summed over a flight, pixels: strips lie a little wrong among
    themselves (of 96 flights of 42 pictures 37 had no consensus; 20 of them are found by the sum, none wrong)."""
    stack_apart_px: int = 6
    """`peak_apart_px` for that sum (measured together)."""
    stack_map_share: float = 0.7
    """Least share of the search area that the map covers, for a strip to be summed (chosen; not measured)."""
    learned_pictures: int = 16
    """Pictures of a strip that is matched by learned features (chosen; not measured)."""
    learned_strips: int = 5
    """Strips of a flight that are matched so: some seconds each (chosen for its time)."""
    learned_across_px: float = 300.0
    """Width of a picture in such a strip, pixels (chosen; not measured)."""
    learned_gsd_m: tuple[float, float] = (0.2, 0.6)
    """Limits of its ground pixel, metres (chosen)."""
    learned_reach_m: float = 30.0
    """How far they are searched, metres (chosen for its time)."""

    # Tie points on the map
    picture_gsd_share: float = 1.07
    """Ground pixel in which pictures are compared with each other, in pixels at nadir (chosen: interpolation blurs)."""
    map_gsd_m: tuple[float, float] = (0.25, 2.0)
    """Limits of the ground pixel in which pictures are compared with the map, metres, where pictures are finer than the
    next field (chosen; not measured)."""
    map_gsd_fine_m: float = 0.4
    """Pictures with a smaller ground pixel than this are compared at the coarser of their and the map's (chosen)."""
    map_gsd_coarse_m: float = 0.5
    """Least ground pixel for all other pictures, metres (chosen)."""
    map_margin_share: float = 1.1
    """The map is read to so many half diagonals of a picture beyond the cameras (chosen: pictures tilt) ..."""
    map_margin_m: float = 40.0
    """... and this, metres: the search and a patch (chosen)."""
    tie_views: int = 3
    """Fewest pictures that show a point which is compared with the map (chosen) ..."""
    tie_views_sparse: int = 2
    """... and of photos that are matched in pairs."""
    tie_view_weight: float = 0.4
    """Least mean robust weight of its observations (chosen; not measured)."""
    tie_height_m: float = 3.0
    """Points farther above or below the ground are not compared, metres: what is around them leans (chosen)."""
    tie_half_share: float = 0.1
    """Half a patch, as a share of the flying height. Measured with half patches of 10, 13, 16 and 20 m from 150 m: on
    maps of another date (benchmarks/accuracy/other_dates.py) errors fall up to 16 m, on relief of 25 m they stay ..."""
    tie_half_limits_m: tuple[float, float] = (10.0, 20.0)
    """... within these limits, metres (chosen: what is on the ground does not grow with the flying height)."""
    tie_half_px: int = 8
    """... and at least so many pixels (chosen)."""
    tie_reach_px: int = 4
    """Least search, pixels, where a search in metres is less (chosen)."""
    first_tie_reach_m: float = 14.0
    """How far a tie point is searched on the map after the coarse registration, to each side; chosen, not measured."""
    tie_reach_m: float = 5.0
    """How far a tie point is searched once the flight lies on the map, metres to each side (chosen; not measured)."""
    first_tie_cell_m: float = 50.0
    """One tie point a leg in each cell of this size, metres, after the coarse registration (chosen for cost)."""
    first_tie_cell_sparse_m: float = 25.0
    """`first_tie_cell_m` of photos that are matched in pairs (chosen for cost)."""
    tie_cell_m: float = 30.0
    """One tie point a leg in each cell of this size, metres, once the flight lies on the map (chosen for cost)."""
    tie_cell_sparse_m: float = 15.0
    """`tie_cell_m` of photos that are matched in pairs (chosen for cost)."""
    map_window_share: float = 0.7
    """Least share of a patch's search window that the map covers (chosen; not measured)."""
    patch_share: float = 0.85
    """Least share of a patch that its picture shows (chosen; not measured)."""
    tie_peak: float = 0.2
    """Least correlation of a tie point (chosen; not measured)."""
    tie_ratio: float = 0.75
    """Largest ratio of the second peak to the first (chosen; not measured)."""
    tie_sigma_m: float = 0.35
    """Sigma of a tie point, an axis, before their residuals tell it, metres (chosen; not measured)."""
    tie_sigma_limits_m: tuple[float, float] = (0.1, 1.0)
    """Limits of the sigma by their residuals, metres: maps of the day are decimetres off, old ones a metre (chosen)."""
    tie_fewest_for_sigma: int = 20
    """Fewer residuals tell no sigma (chosen)."""
    edge_fewest: int = 60
    """Fewer tie points do not tell how far strong edges are displaced from texture (chosen: a mean to centimetres)."""
    edge_most: int = 300
    """More are not compared (chosen for cost)."""
    edge_search_m: float = 2.5
    """How far the edges of tie points are searched, metres: the flight is decimetres off by then (chosen for cost)."""
    edge_reach_m: float = 1.0
    """Differences farther than this from their median are gross errors, metres (chosen)."""

    # Evidence
    evidence_fewest: int = 4
    """Fewest tie points of a leg or a flight: fewer agree with themselves alone."""
    evidence_pairs: int = 400
    """Most lines through two tie points that are tried in a group (chosen for its time)."""
    evidence_tolerances_m: tuple[float, float, float] = (0.7, 1.5, 3.0)
    """Distances within which tie points agree on a place on the map: after a good adjustment, with tilt and drift left,
    for sparse photos; chosen, not measured."""
    evidence_small_half_m: float = 4.0
    """Half a patch where those of the usual size confirm nothing: so that flights of three photos have some dozens;
    chosen, not measured."""
    false_matches: float = 1e-4
    """A flight is taken to lie on the map if a map of other ground would show an agreement of tie points as good as the
    one found so many times only (expected number of false matches); measured by benchmarks/robustness/wrong_maps.py."""
    leg_by_chance: float = 0.01
    """A leg of such a flight is matched if its ties agree with its place by chance with this probability only."""
    leg_agrees_m: float = 1.2
    """A tie point whose residual is below this agrees with its leg's place, metres (chosen; not measured)."""
    sparse_fewest_observations: int = 12
    """Photos that are matched in pairs and have fewer observations are weakly determined (chosen; not measured)."""

    # From the first tie points to the adjustment
    mode_m: float = 0.7
    """The shift that most tie points agree on has most others within this distance, metres (chosen; not measured)."""
    mode_scales_m: tuple[float, float, float, float, float] = (0.5, 0.5, 0.35, 0.25, 0.25)
    """Scales of the reweighted means that refine it, metres (chosen; not measured)."""
    line_scales_m: tuple[float, float, float, float, float, float] = (4.0, 2.0, 1.0, 0.7, 0.5, 0.5)
    """Scales of the reweighted fits of the line of shifts along a leg, metres (chosen; not measured)."""
    line_fewest: int = 6
    """Fewest tie points of a leg that must agree on such a line (chosen) ..."""
    line_least_share: float = 0.6
    """... and the least share of its tie points (chosen; not measured)."""
    line_agrees_m: float = 0.7
    """Tie points this near to the line agree with it, metres (chosen; not measured)."""
    line_apart_m: float = 0.7
    """A leg whose line is nowhere farther from the common shift is moved by the common shift, metres (chosen)."""
    first_tie_scales: tuple[float, float, float, float] = (36.0, 9.0, 6.0, 6.0)
    """Robust scales of the first tie points in its steps (chosen; not measured)."""
    tie_scales: tuple[float, float] = (9.0, 6.0)
    """Robust scales of later tie points, in the first step and in all others (chosen; not measured)."""
    second_steps: int = 3
    """Steps with the second tie points (chosen)."""
    renewed_steps: int = 4
    """Steps with renewed tie points of a flight that lies on the map already, after two with the old ones (chosen)."""

    # Roofs, which show how the map leans
    roof_views: int = 6
    """Fewest pictures that show a raised point (chosen; not measured)."""
    roof_view_weight: float = 0.5
    """Least mean robust weight of its observations (chosen; not measured)."""
    roof_heights_m: tuple[float, float] = (4.0, 40.0)
    """Heights over the ground, metres: a floor, and what is probably a wrong track (chosen)."""
    roof_cell_m: float = 30.0
    """One roof a leg in each cell of this size, metres (chosen for cost)."""
    roof_half_m: float = 7.5
    """Half a patch, metres: about a roof (chosen)."""
    roof_reach_m: float = 11.0
    """How far it is searched, metres: maps lean by up to 0.3 m a metre (chosen)."""
    roof_ratio: float = 0.85
    """Largest ratio of the second peak to the first; the vote sorts out wrong ones (chosen)."""
    lean_fewest: int = 12
    """Fewest roofs, by count and by sum of weights, that tell the lean (chosen; not measured)."""
    lean_sigma_m: float = 0.25
    """Sigma of a roof's shift, metres (chosen; not measured) ..."""
    lean_sigma_share: float = 0.05
    """... plus this share of its height (chosen; not measured)."""
    lean_scale: float = 4.0
    """Robust scale of the vote (chosen: 2 sigmas)."""
    lean_most: float = 1.0
    """Largest lean, metres of shift a metre of height (chosen: 45 degrees)."""
    lean_over_none: float = 1.5
    """A lean must have so many times the sum of weights that no lean has (chosen; not measured)."""
    lean_least_share: float = 0.25
    """... and at least this mean weight (chosen; not measured)."""

    # Links: points of one leg observed in pictures of other legs, or of neighbouring vehicles
    link_cell_m: float = 40.0
    """One point a leg in each cell of this size, metres (chosen for cost)."""
    link_views: int = 3
    """Fewest pictures that show the point (chosen)."""
    link_view_weight: float = 0.5
    """Least mean robust weight of its observations (chosen; not measured)."""
    link_pictures: int = 3
    """Most other legs in which a point is observed, one picture each (chosen for cost)."""
    link_half_px: int = 15
    """Half a patch, pixels (chosen; not measured)."""
    link_reach_px: int = 6
    """How far it is searched, pixels (chosen; not measured)."""
    link_margin_px: float = 12.0
    """Points nearer to a picture's border are not searched in it, working pixels (chosen)."""
    link_template_share: float = 0.95
    """Least share of the patch that its own picture shows (chosen) ..."""
    link_window_share: float = 0.8
    """... and of the search window in the other picture (chosen)."""
    link_apart_px: int = 3
    """Correlations within this distance, pixels, belong to the same peak (chosen)."""
    link_peak: float = 0.45
    """Least correlation of a link (chosen; not measured)."""
    link_ratio: float = 0.8
    """Largest ratio of the second peak to the first (chosen; not measured)."""
    links_at_once: int = 2_000
    """Points whose patches are held at once, 9 kB each (chosen for memory)."""
    link_sigma_px: float = 0.7
    """Sigma of a link to another leg, working pixels (chosen; not measured)."""
    neighbour_sigma_px: float = 1.5
    """Sigma of a link to another vehicle, whose cameras do not move, working pixels (chosen; not measured)."""
    neighbour_pictures: int = 2
    """Most vehicles in which a point is observed, one picture each (chosen for cost)."""
    neighbour_reach_heights: float = 1.2
    """Cameras of other vehicles within so many flying heights of the path may show its ground (chosen)."""
    neighbour_every: int = 2
    """Every so-manieth of these cameras is used: neighbours in time show the same (chosen for cost)."""

    # A vehicle that the map does not show, registered to its neighbours
    unfound_reach_px: int = 24
    """How far points are searched in the neighbours' pictures once strips agree, pixels: relief moves them by metres
    across a border (chosen)."""
    unfound_cell_share: float = 0.15
    """`link_cell_m` for it is at most this share of a picture's width: low flights have room for few points 40 m apart
    (chosen; legs of six photos from 40 m had 2 to 4 links)."""
    unfound_scales: tuple[float, float, float, float, float] = (1e4, 400.0, 36.0, 9.0, 9.0)
    """Robust scales of the steps with these links (chosen; not measured)."""
    unfound_fewest: int = 8
    """Fewest links that must agree in the end, or the vehicle stays where its receiver says (chosen) ..."""
    unfound_least_share: float = 0.4
    """... and the least share of them (chosen; not measured)."""
    unfound_agrees: float = 0.3
    """Links with at least this robust weight agree (chosen)."""
    unfound_reach_share: float = 0.6
    """Neighbours' pictures are drawn to this share of their diagonal from their cameras (chosen: half and some
    tilt)."""

    # Maps of far coarser pixels than the pictures, on which one shift of all vehicles is found
    coarse_map_gsd_m: float = 4.5
    """On maps with larger pixels, metres, no tie points are searched. On three sets (0.47 m a pixel) maps of 4 m
    place pictures within 0.3 to 0.8 m by tie points, 0.7 to 0.9 m by one shift; of 5 m within 1.5 to 1.7 m by tie
    points with sigmas of 0.6 to 1.3 m, 1.2 to 1.8 m by one shift with 1.2 to 1.4 m; of 10 m not at all by ties ..."""
    coarse_map_pictures: float = 8.0
    """... unless they are smaller than so many of the pictures' pixels (chosen; not measured)."""
    coarse_map_share: float = 0.95
    """Least share of a map's pixel that the pictures must show (chosen; not measured)."""
    coarse_map_texture: float = 0.5
    """Length of gradients with the most weight, in medians: strong edges belong to what leans and casts shadows. Error
    of an axis on four sets with 0.5 and 1.0: 0.82 and 1.07 m on maps of 5 m, 1.92 and 2.09 m of 10 m."""
    coarse_map_parts: int = 16
    """Parts of the ground that are left out in turn to find the shift's sigma (chosen for its time)."""
    coarse_map_sigma_px: float = 0.22
    """What shadows and leaning buildings of the map displace, one sigma an axis, in its pixels: 1.9 m at 10 m and 0.8 m
    at 5 m on four sets with maps from 12 to 15 degrees off nadir, 2.3 and 2.0 m in another season; a map without lean
    is right to 0.5 m at 10 m."""

    # Vehicles that no map holds, registered to each other and placed by all their receivers
    datum_shift_sigma_m: float = 100.0
    """What is known of the shift of such a block before its receivers are asked, metres: nothing (chosen)."""
    datum_rounds: int = 5
    """Rounds of reweighting, so that a receiver that is far off counts little (chosen: it has settled by then)."""

    # Heights of ground that only oblique views show, from the map
    oblique_cell_share: float = 0.06
    """Distance of the positions, as a share of the flying height (chosen for cost) ..."""
    oblique_cell_m: float = 5.0
    """... and at least this, metres (chosen)."""
    oblique_slope: float = 0.35
    """Horizontal distance over height from which on a view counts as oblique: 19 degrees (chosen; not measured)."""
    oblique_half_m: float = 10.0
    """Half a patch, metres: smaller than a tie point's, since ground seen obliquely tilts what is around (chosen)."""
    oblique_reach_m: float = 6.0
    """How far a patch is searched, metres (chosen; not measured)."""
    oblique_across_m: float = 0.6
    """What is found lies this near to the line of sight, metres, or is another place (chosen; not measured)."""
    oblique_sigma_share: float = 1.5
    """Sigma of such a place, in sigmas of the tie points, which are averages over a leg's views (chosen)."""
    oblique_views: int = 8
    """Most cameras, nearest first, that are asked whether they show a position (chosen for its time)."""

    # The map against the receivers
    receiver_bias_sigma_m: float = 1.5
    """Bias of a receiver without corrections over a flight, an axis: multipath, satellites of its own (chosen; good
    receivers under open sky differ by 1 to 2 m)."""
    receiver_common_sigma_m: float = 1.5
    """The part of the error that all receivers at a place and time share, an axis: ionosphere and orbits. The GPS
    standard (SPS PS 2020) commits to 8 m (95 %) horizontally on average; 3 to 4 m are usual, most of it shared
    (chosen)."""
    corrected_sigma_m: float = 0.5
    """A position that states at most this sigma was corrected (RTK, PPK)."""
    corrected_floor_m: float = 0.05
    """Corrected positions are not trusted better than this: antenna offset, base station (chosen)."""
    offset_outlier: float = 5.0
    """Differences of more than so many median distances from the median are gross errors (chosen)."""
    offset_probability: float = 0.01
    """The map is doubted if the receivers would be so far from a right map with this probability only."""
