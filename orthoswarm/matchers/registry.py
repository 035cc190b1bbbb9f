"""The registry: matchers by name, built in or added by other packages through entry points.

A package adds one with an entry point in the group `orthoswarm.matchers` whose value is a callable without arguments
that returns a PictureMatcher or a MapMatcher:

    [project.entry-points."orthoswarm.matchers"]
    mine = "my_package:MyMatcher"
"""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from orthoswarm.matchers.matcher import MapMatcher, PictureMatcher, UnavailableError
from orthoswarm.model.errors import InputError

GROUP = "orthoswarm.matchers"
PICTURE_ORDER = ("xfeat", "sift")
"""Default matcher of pictures: the first of these that is available."""
MAP_ORDER = ("xfeat-window", "cfog")
"""Default matcher of patches on the map: the first of these that is available."""


def _learned(kind: Any) -> PictureMatcher:
    from orthoswarm.matchers.sparse_learned import Learned

    return Learned.make(kind)


def _sift() -> PictureMatcher:
    from orthoswarm.matchers.sift import Sift

    return Sift()


def _window() -> MapMatcher:
    from orthoswarm.matchers.dense_window import XFeatWindow

    return XFeatWindow.make()


def _cfog() -> MapMatcher:
    from orthoswarm.matchers.cfog import Cfog

    return Cfog()


def _roma() -> MapMatcher:
    from orthoswarm.matchers.roma import Roma

    return Roma.make()


PICTURE: dict[str, Callable[[], PictureMatcher]] = {
    "xfeat": lambda: _learned("xfeat"),
    "disk": lambda: _learned("disk"),
    "aliked": lambda: _learned("aliked"),
    "sift": _sift,
}
MAP: dict[str, Callable[[], MapMatcher]] = {"xfeat-window": _window, "cfog": _cfog, "roma": _roma}


def picture_matcher(name: str | None = None) -> PictureMatcher:
    """A matcher of pictures by name; without a name the first available of PICTURE_ORDER.

    Raises:
        InputError: if the name is unknown, or its weights or packages are missing.
    """
    matcher: PictureMatcher = _get(name, PICTURE, PICTURE_ORDER)
    return matcher


def map_matcher(name: str | None = None) -> MapMatcher:
    """A matcher of patches on the map by name; without a name the first available of MAP_ORDER.

    Raises:
        InputError: if the name is unknown, or its weights or packages are missing.
    """
    matcher: MapMatcher = _get(name, MAP, MAP_ORDER)
    return matcher


def available() -> dict[str, str]:
    """Every matcher, built in or added, with the reason why it cannot be used (empty: it can)."""
    out = {}
    for name, make in {**PICTURE, **MAP, **_added()}.items():
        try:
            make()
            out[name] = ""
        except UnavailableError as error:
            out[name] = str(error)
        except Exception as error:  # code of other packages may raise anything
            out[name] = f"it cannot be loaded ({type(error).__name__}: {error})"
    return out


def _added() -> dict[str, Callable[[], Any]]:
    """Matchers of other packages."""
    return {point.name: _entry(point) for point in entry_points(group=GROUP)}


def _entry(point: Any) -> Callable[[], Any]:
    return lambda: point.load()()


def _get(name: str | None, own: dict[str, Any], order: tuple[str, ...]) -> Any:
    if name is None:
        for candidate in order:
            try:
                return own[candidate]()
            except UnavailableError:
                continue
        raise InputError(f"no matcher is available; one of {', '.join(order)} is needed")
    known = {**own, **_added()}
    if name not in known:
        raise InputError(f"there is no matcher '{name}'; choose one of {', '.join(sorted(known))}")
    try:
        return known[name]()
    except UnavailableError as error:
        raise InputError(f"the matcher '{name}' cannot be used: {error}") from None
