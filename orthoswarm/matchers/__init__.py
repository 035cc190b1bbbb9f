"""Image matchers behind one registry, for two pictures of a flight, and for a rectified patch and the map.

A PictureMatcher takes two pictures of one flight, without their poses. A MapMatcher takes a rectified patch and a
larger window of the map around its expected position (the prior window). Learned matchers need weights from packages
(`orthoswarm weights`); SIFT and CFOG need none.
"""

from orthoswarm.matchers.matcher import MapMatcher, Matches, PictureMatcher
from orthoswarm.matchers.patch_registration import second_opinion
from orthoswarm.matchers.registry import available, map_matcher, picture_matcher

__all__ = [
    "MapMatcher",
    "Matches",
    "PictureMatcher",
    "available",
    "map_matcher",
    "picture_matcher",
    "second_opinion",
]
