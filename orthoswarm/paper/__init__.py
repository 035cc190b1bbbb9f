"""The paper's own refiner, as written: lines, scale and field of view (III.C), leg patches on the map (III.D).

It is here to be compared with; the default refiner (orthoswarm.refine) is more accurate. docs/method.md tells where
the paper is ambiguous and what is done about it.
"""

from orthoswarm.paper.paper_refiner import Options, PaperRefiner

__all__ = ["Options", "PaperRefiner"]
