"""Maps, pictures and height models that are read, and maps that are written in tiles."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Maps, pictures and height models that are read, and maps that are written in tiles."""

    # Maps
    collar_px: int = 15
    """Plain black or plain white squares of at least this side, pixels, in a map without a mask are its collar and no
    ground (chosen; not measured)."""
    stretch_percent: tuple[float, float] = from_zero((0.5, 99.5))
    """Percentiles of a map of more than 8 bits that become 0 and 255 (chosen; usual in GIS: 2 and 98, which clips
    roofs)."""
    check_side: int = 5
    """Windows a side of the lattice at which a map's pixels are read before the work begins (chosen for its time)."""
    check_window_px: float = 4.0
    """Side of these windows, pixels (chosen for its time)."""

    # Pictures
    depth_full: float = 32768.0
    """16-bit pictures whose upper values (`stretch_percent`) reach this use all bits: 256 of their levels become one.
    Others, with 10 to 14 bits, are stretched like maps (chosen: half of the range)."""
    depth_pictures: int = 9
    """Pictures of a folder that tell the range of its 16-bit pictures (chosen for its time)."""
    depth_values: int = 20_000
    """About so many values of each of them (chosen for its time)."""
    grey_pictures_mb: float = from_zero(1500.0)
    """Grey pictures at the refiner's working size that take no more than this together, megabytes, are kept on disk
    during a batch run (chosen for the disk). They come from the colours then: a grey level off by rounding, a few
    where a colour is clipped."""
    picture_parts_mb: float = from_zero(2000.0)
    """Parts of pictures that are kept on disk between two drawings of a batch run take no more than this together,
    megabytes (chosen for the disk); larger ones are decoded again."""
    part_margin: float = from_zero(0.1)
    """What the real-time map shows of a picture is kept for the refined maps with a border of this share of the
    picture's longer side; what they need beyond it is decoded again (measured on 1,017 photos: 6 % are)."""

    # Height models
    dem_finest_m: float = 2.0
    """Finest distance of the nodes on which a height model is read, metres: buildings that lean in it are averaged
    (chosen; not measured)."""
    dem_mean_steps: float = 0.7
    """Where its pixels are smaller than so many distances of nodes, a node has their mean (chosen) ..."""
    dem_highest_steps: float = 1.5
    """... or the highest of them where the highest ground is asked for: up to this also where pixels are hardly
    larger, since between them a mast of one pixel would lose height (chosen)."""
    dem_margin_m: float = from_zero(50.0)
    """A height model is read so far beyond the places that are asked for, metres (chosen: some of its nodes)."""
    dem_most_nodes: int = 4_000_000
    """Most nodes read from a height model as a whole (chosen for memory)."""
    dem_window_nodes: int = 250_000
    """Most nodes of a window of it (chosen for memory)."""
    dem_most_buried: float = 0.05
    """Share of the cameras that a height model may bury: a few recorded heights can be wrong (chosen)."""
    dem_least_cover: float = 0.02
    """A height model with heights on a smaller share of the area than this is of another place (chosen)."""

    # Maps that are written
    one_file_px: float = 4e9
    """A map of more pixels is written in tiles where the user does not say how, pixels (chosen: 40 square kilometres at
    0.1 m; as one file it has some 10 GB, which web servers, object storage and copying by radio handle badly)."""
    tile_px: int = 8192
    """Side of such a tile, pixels, a multiple of 512 (chosen: some 100 MB a file)."""
