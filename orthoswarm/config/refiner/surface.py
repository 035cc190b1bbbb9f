"""Terrain, dense ground points, height models, tall surfaces.

Lengths that scale with the flying height are stated for `reference_height_m` above ground.
"""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """Terrain, dense ground points, height models, tall surfaces."""

    reference_height_m: float = 150.0
    """Flying height above ground for which lengths of the vertical line locus and of the dense cells are stated; they
    are scaled to the height flown."""

    # Points of the adjustment that are fit for the terrain

    ground_point_observations: int = 4
    """Least observations of a point that the terrain is fitted to (chosen; not measured)."""
    ground_point_weight: float = 0.6
    """Least mean robust weight of such a point's observations (chosen; not measured)."""
    ground_point_sigma_m: float = 1.5
    """Largest sigma of such a point's height, metres (chosen; not measured)."""
    terrain_points: int = 60
    """With fewer points no terrain is fitted; the ground stays level, or as it was (chosen; not measured)."""
    terrain_reach_heights: float = 1.08
    """How far beyond the outermost cameras the terrain reaches, in flying heights (chosen: past the pictures' edge)."""
    level_spacing_m: float = 7.5
    """Nodes that are nearer to each other than this are thinned for the level of the mapped ground, metres (chosen)."""
    level_reach_heights: float = 0.5
    """Ground within so many flying heights of a camera counts for the level of the mapped ground: what lies farther out
    is seen obliquely, and its height is known less well (chosen; on flat ground 0 to 1 agree within 0.05 m)."""
    height_prior_sigma_m: float = 2.0
    """Sigma of the robust height prior of points about the terrain, metres (chosen; not measured)."""
    height_prior_soft_sigma_m: float = 20.0
    """Sigma of the weak height prior that is not robust, so that no point runs away, metres (chosen; not measured)."""
    height_prior_robust_c: float = 1.0
    """Scale c of the robust height prior's kernel, squared sigmas (chosen; not measured)."""

    # Smooth surface below the points

    node_spacing_m: float = 30.0
    """Distance of the terrain's nodes, metres (chosen; not measured)."""
    point_sigma_floor_m: float = 0.25
    """Added in squares to every point's own sigma, metres: the ground is rougher than points are exact (chosen)."""
    robust_start_m: float = 10.0
    """Robust scale above the surface in the first solve, metres: higher than most houses (chosen; not measured)."""
    robust_end_m: float = 0.3
    """Robust scale above the surface in the last solve, metres. It seeks the mode of the heights: 0.6 above and 1.5
    below let cars and bushes lift the surface by 0.1 to 0.2 m (measured on synthetic towns)."""
    robust_below_factor: float = 3.0
    """The robust scale below the surface is this multiple of that above: equal scales climb roofs at the border."""
    robust_below_least_m: float = 0.8
    """The robust scale below the surface is never less than this, metres (see `robust_end_m`)."""
    robust_solves: int = 12
    """Solves over which the robust scale shrinks geometrically from start to end (chosen; not measured)."""
    slope_sigma_m: float = 6.0
    """Sigma of first differences between nodes, metres: ground is rather level (chosen; not measured)."""
    slope_full_kappa_m: float = 0.8
    """Smoother surfaces (a smaller kappa) get a sigma of first differences smaller in proportion (chosen)."""
    open_slope_ratio: float = 1.5
    """Sigma of first differences next to nodes without data, as a multiple of kappa: beyond the data the surface goes
    on level instead of diving (linear extrapolation dived by 4 to 10 m at borders)."""
    kappas_m: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
    """Smoothness tried by the hold-out, from smooth to rough: sigma of the second difference between nodes 30 m apart,
    metres (scaled for other distances, so that it means the same ground)."""
    hold_out_every: int = 4
    """Every so many-th point is left out to find the smoothness (chosen; not measured)."""
    hold_out_points: int = 10
    """With fewer points left out the smoothest surface is taken (chosen; not measured)."""
    hold_out_solves: int = 8
    """Solves for each smoothness tried (chosen for its cost; not measured)."""
    hold_out_standard_errors: float = 0.5
    """The smoothest surface is taken whose error at points left out lies within so many standard errors of the best:
    the best itself is too rough on rubble, which is real but no ground."""
    flat_relief_m: float = from_zero(0.5)
    """Relief of this standard deviation or less is noise to the adjustment's height prior, metres: an unshrunk prior on
    flat ground follows each vehicle's own level."""
    tile_nodes: int = 40
    """Larger areas are solved in tiles of so many nodes a side: the cost grows with the square of the shorter side."""
    tile_overlap_nodes: int = 8
    """Nodes by which tiles overlap on each side: nodes this far away have no influence where there is data."""
    tile_kappa_votes: int = 4
    """So many of the fullest tiles ask for a smoothness, and the median is taken for all (chosen for its cost)."""
    ground_mode_kernel_m: float = 0.15
    """Gaussian kernel of the density of heights in which the ground's level is sought, metres (chosen)."""
    ground_mode_window_m: float = 15.0
    """Heights farther than this from the median do not count for the ground's level, metres (chosen)."""
    ground_mode_bin_m: float = 0.05
    """Bin of that density, metres: a third of its kernel (chosen for exactness)."""
    ground_mode_share: float = 0.4
    """The lowest peak of at least this share of the highest one's density is the ground: corners crowd on car roofs."""
    points_centre_scale_m: float = 2.0
    """Robust scale of the points' centre over the ground, metres; that of the adjustment's height prior."""

    # Surface for drawing

    drawn_nodes: int = 4_000_000
    """Most nodes of a surface that pictures are drawn on (chosen for memory)."""
    drawn_hold_out_standard_errors: float = 1.0
    """As `hold_out_standard_errors`, of the surface for drawing: one as smooth as the points allow, so that rubble in
    the middle does not roughen the border."""
    drawn_flat_relief_m: float = from_zero(0.15)
    """As `flat_relief_m`, for drawing: there following noise costs less than missing relief."""
    drawn_on_map_sigma_floor_m: float = 0.15
    """As `point_sigma_floor_m`, where heights by the map are among the points (chosen with them: the 95 % of the map's
    error fell by a quarter on flat ground, by half on relief)."""
    drawn_on_map_flat_relief_m: float = 0.0
    """As `drawn_flat_relief_m`, with heights by the map: the surface is drawn as it is fitted."""

    # Open ground against the surface through corners

    offset_positions: int = 900
    """Free positions at which the ground is measured against the surface, drawn once (chosen; 0.05 s)."""
    offset_spread_m: float = 100.0
    """Half side of the square about each camera in which positions are drawn, metres at the reference height: to the
    border of what the outer pictures see."""
    offset_least_heights: int = 60
    """With fewer heights found the offset is 0 (chosen; not measured)."""
    offset_kernel_m: float = 0.2
    """Gaussian kernel of the mode of the differences, metres (chosen; not measured)."""
    offset_limits_m: tuple[float, float] = (-1.5, 0.5)
    """The offset is clipped to this range, metres: corners sit on raised things, nothing digs them in (chosen)."""
    offset_reach_m: float = 3.0
    """Heights searched above and below the surface for the offset, metres (chosen; not measured)."""
    offset_height_step_m: float = 0.25
    """Distance of the heights searched for the offset, metres at the reference height (chosen; not measured)."""

    # Vertical line locus (the ASPRS manual's term): heights at free positions

    sweep_reach_m: float = 9.0
    """Heights searched above and below the terrain, metres (chosen; not measured)."""
    sweep_height_step_m: float = 0.375
    """Distance of the heights searched, metres at the reference height; peaks are interpolated by a parabola."""
    sweep_baselines_m: tuple[float, ...] = (40.0, 75.0, 110.0)
    """Wished distances of partner pictures on both sides of the reference picture, metres at the reference height."""
    sweep_spacing_m: float = 17.0
    """Only pictures this far apart along a leg are used, metres at the reference height: few have to be decoded."""
    sweep_least_baseline_share: float = 0.4
    """Least baseline as a share of the shortest that is wished (chosen; not measured)."""
    sweep_partners: int = 3
    """Partners below which pictures of other legs are asked for, where a leg ends (chosen; not measured)."""
    sweep_rival_m: float = 4.0
    """A second peak farther than this from the best makes a height ambiguous, metres at the reference height."""
    sweep_rival_share: float = 0.95
    """... if it is above this share of the best (chosen; not measured)."""
    sweep_least_variance: float = 2.0
    """Least variance of a patch's grey values, squared: less is the noise of a JPEG."""
    sweep_steepest: float = 1.5
    """Steepest slope of a patch's plane: a height model has walls, and no patch is a plane across one (chosen)."""
    sweep_slope_reach_m: float = 5.0
    """The slope below a patch is taken over this distance at least, metres (chosen; not measured)."""
    sweep_pictures: int = 64
    """Pictures held at a time (chosen for memory)."""
    small_patch_half: int = 4
    """Half width of the small patch, samples: 9 x 9."""
    small_patch_step_m: float = 0.5
    """Distance of its samples, metres at the reference height. It fits between cars, bushes and houses: on a street
    scene three quarters of its heights lie within 0.2 m of bare ground, half of the large one's, most others above."""
    small_patch_score: float = 0.7
    """Least mean normalised correlation of the small patch (chosen; not measured)."""
    small_patch_sigma_m: float = 0.15
    """Sigma of its heights, metres at the reference height (see `small_patch_step_m`)."""
    large_patch_half: int = 7
    """Half width of the large patch, samples: 15 x 15; it finds heights on ground with little texture."""
    large_patch_step_m: float = 0.7
    """Distance of its samples, metres at the reference height (chosen; not measured)."""
    large_patch_score: float = 0.6
    """Least mean normalised correlation of the large patch (chosen; not measured)."""
    large_patch_sigma_m: float = 0.25
    """Sigma of its heights on open ground, metres at the reference height (chosen; not measured)."""
    dense_cell_m: float = 14.0
    """Side of the cells that get one height each, metres at the reference height (chosen; not measured)."""
    dense_most_cells: int = 400_000
    """Areas of more cells are left without dense points (chosen for memory)."""
    high_from_m: float = 6.0
    """From this height over the ground on cells without ground are searched for what stands high, metres."""
    high_to_share: float = 0.25
    """... up to this share of the flying height (chosen; not measured)."""
    high_baselines_m: tuple[float, ...] = (25.0, 50.0, 75.0)
    """Baselines of that search, metres at the reference height: what stands high is near the cameras, so fewer pictures
    show it."""

    # What stands on the ground, measured by a plane sweep on the nodes that it is drawn on

    tall_from_m: float = 1.5
    """What differs less from the ground belongs to it, metres (chosen; not measured)."""
    tall_near_m: float = 18.0
    """Heights are measured within this distance of raised points, metres at the reference height: more than that of the
    dense cells (chosen; not measured)."""
    tall_above_m: float = 2.0
    """... and up to so much above the highest of them, metres (chosen: 0 and larger distances change the share of
    nodes within 1 m by at most 0.008 on two scenes)."""
    tall_cell_m: float = 1.25
    """Distance of the nodes whose heights are measured, metres at the reference height (chosen; not measured)."""
    tall_block_nodes: int = 48
    """Side of the blocks of nodes that are measured at a time, in the same pictures (measured: of 96 nodes 82.9 % of
    those on wide roofs are right within 1 m instead of 84.5 %, beside them 90.4 instead of 93.2; 32 are no better)."""
    tall_block_border_nodes: int = 4
    """Nodes around a block that it is measured with (measured: 8 nodes take a third more time, and 0.3 per cent more
    nodes on wide roofs are right within 1 m). The outermost may lie at any height."""
    tall_blocks_per_task: int = 16
    """Blocks of one task, so that neighbours read a picture once (chosen for memory)."""
    tall_height_step_m: float = 0.75
    """Step of the heights, metres at the reference height: a third of a pixel's parallax (chosen; not measured)."""
    tall_best_base: float = 0.45
    """Wished distance of the pictures compared over the flying height (measured: 0.55 is as good; of 0.35 one per cent
    fewer nodes are right within 1 m, of 0.25 five)."""
    tall_least_base: float = 0.12
    """... and the least: nearer pictures give inaccurate heights (chosen; not measured)."""
    tall_noise_levels: float = 1.0
    """Sigma of grey values below which a cell's texture says nothing (measured: with 2 a tenth fewer of a plain roof's
    nodes are right within 1 m; less than 1 is the noise of a JPEG)."""
    tall_doubt: float = 0.07
    """Cost of any height against the ground, in correlation: what is not sure is ground (measured: with 0.05 more roofs
    are whole and more of the ground beside them is raised, with 0.1 the other way round)."""
    tall_hidden_cost: tuple[float, float] = (0.2, 0.4)
    """Least and greatest cost, in correlation, of a height at which something taller hides the cell from the picture
    compared (measured: with greater ones more roofs are whole and more of the ground behind them is raised)."""
    tall_hidden_m: float = 1.0
    """What rises above a line of sight by less than this hides nothing, metres (measured: 0.5 is no better)."""
    tall_slope_cost: float = 0.15
    """Cost of a step to the next height between cells, in correlation (chosen; not measured)."""
    tall_edge_cost: tuple[float, float] = (0.15, 1.2)
    """Cost of a larger step across a strong edge of the picture, and on even ground (measured: 0.3 and 1.2 give 0.4 per
    cent fewer right nodes, 0.3 and 1.8 another 0.7)."""
    tall_edge_levels: float = 8.0
    """Difference of grey values that halves what is between these costs (chosen; not measured)."""
    tall_reach_heights: float = 1.5
    """Pictures whose nadir points are farther away, in flying heights, are not compared (chosen for its time)."""
    tall_rim_share_px: float = 0.05
    """Share of a picture's sides at its rim that a block's middle must not lie in (chosen; not measured)."""

    # Levels of vehicles

    level_radius_m: float = 25.0
    """Points of two vehicles this near each other, horizontally, are common ground, metres (chosen)."""
    level_neighbours: int = 3
    """Points of the other vehicle within that radius whose median height is compared (chosen; not measured)."""
    level_least_points: int = 15
    """Common points that make a pair of vehicles (chosen; not measured)."""
    level_most_points: int = 400
    """Points of each vehicle compared in a pair: a median of more is no better."""
    level_sigma_floor_m: float = 0.03
    """Least sigma of a pair's difference, metres (chosen; not measured)."""
    level_spread_flat_m: float = 0.8
    """Spread of the levels up to which the least corrected vehicle stays, metres: rubble only lifts points."""
    level_spread_relief_m: float = 1.6
    """Spread of the levels from which their mean stays, metres: relief (both chosen; not measured)."""
    level_quantile: float = 0.1
    """Of many vehicles this quantile stands for the lowest: the lowest of many is noise (chosen; not measured)."""
    level_many_vehicles: int = 10
    """More vehicles than this are many (chosen; not measured)."""

    # Height model given by the user

    dem_block_m: float = 64.0
    """Windows of a height model lie on multiples of this, metres: a path that moves does not read the file again."""
    dem_nodes: int = 150_000
    """Nodes of the height model in memory for one vehicle (chosen for memory)."""
    dem_rougher_m: float = 0.3
    """A model contradicts the pictures if heights over it vary by so much more than the ground, metres (chosen)."""
    dem_noise_m: float = 0.4
    """Differences from a model of this size are errors of the points' own surface, metres (chosen: such a surface errs
    by decimetres, most where points end)."""
    dem_noise_least_share: float = 0.25
    """A model that seldom agrees is kept only against differences below this share of `dem_noise_m` (chosen)."""
    dem_noise_nodes: float = 2.0
    """Differences are averaged over a Gaussian of this sigma, nodes (chosen; not measured)."""
    dem_trusted_m: float = 0.15
    """Median difference up to which a model is better than the points' own surface, metres (chosen)."""
    dem_doubted_m: float = 0.3
    """Median difference from which it is not, metres (chosen; not measured)."""
    dem_level_kernel_m: float = 0.2
    """Gaussian kernel of the mode by which the model's level is found, metres (chosen; not measured)."""
    dem_least_points: int = 60
    """With fewer points on a model its level is a guess, and it is left out (chosen; not measured)."""
    dem_seam_m: float = 90.0
    """Over this distance the ground beyond a model is led to its level at the border, metres (chosen)."""
