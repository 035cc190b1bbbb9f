"""Maps, pictures and height models that are read, and maps that are written in tiles."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Maps, pictures and height models that are read, and maps that are written in tiles."""

    # Maps
    stretch_percent: tuple[float, float] = from_zero((0.5, 99.5))
    """Percentiles of a map of more than 8 bits that become 0 and 255 (chosen; usual in GIS: 2 and 98, which clips
    roofs)."""

    # Pictures
    grey_pictures_mb: float = from_zero(1500.0)
    """Grey pictures at the refiner's working size that take no more than this together, megabytes, are kept on disk
    during a batch run (chosen for the disk). They come from the colours then: a grey level off by rounding, a few
    where a colour is clipped."""
    picture_parts_mb: float = from_zero(2000.0)
    """Parts of pictures that are kept on disk between two drawings of a batch run take no more than this together,
    megabytes (chosen for the disk); larger ones are decoded again."""

    # Maps that are written
    one_file_px: float = 4e9
    """A map of more pixels is written in tiles where the user does not say how, pixels (chosen: 40 square kilometres at
    0.1 m; as one file it has some 10 GB, which web servers, object storage and copying by radio handle badly)."""
    tile_px: int = 8192
    """Side of such a tile, pixels, a multiple of 512 (chosen: some 100 MB a file)."""
