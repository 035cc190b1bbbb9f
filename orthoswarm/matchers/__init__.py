"""Matchers behind one registry: what finds the same ground in two pictures, and in a picture and the map.

Two kinds. A PictureMatcher takes two pictures of one flight and knows nothing of where they lie. A MapMatcher takes a
rectified patch and a larger window of the map around the place where the patch should lie (the prior window).
Learned ones need weights from packages (`orthoswarm weights`); SIFT and CFOG need none.
"""

from orthoswarm.matchers.matcher import MapMatcher, Matches, PictureMatcher
from orthoswarm.matchers.registry import available, map_matcher, picture_matcher
from orthoswarm.matchers.second_opinion import second_opinion

__all__ = [
    "MapMatcher",
    "Matches",
    "PictureMatcher",
    "available",
    "map_matcher",
    "picture_matcher",
    "second_opinion",
]
