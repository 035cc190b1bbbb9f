"""The paper's own refiner, as written: lines, scale and field of view (III.C), leg patches on the map (III.D).

It serves for comparison; the default refiner (orthoswarm.refine) is more accurate. docs/method.md lists where the
paper is ambiguous and how each case is decided here.
"""

from orthoswarm.paper.coarse_cameras import PaperOptions
from orthoswarm.paper.paper_refiner import PaperRefiner

__all__ = ["PaperOptions", "PaperRefiner"]
