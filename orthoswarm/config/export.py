"""Files for other programs."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportConfig:
    """Files for other programs."""

    one_file_px: float = 4e9
    """A map of more pixels is written in tiles where the user does not say how, pixels (chosen: 40 square kilometres at
    0.1 m; as one file it has some 10 GB, which web servers, object storage and copying by radio handle badly)."""
    tile_px: int = 8192
    """Side of such a tile, pixels, a multiple of 512 (chosen: some 100 MB a file)."""
