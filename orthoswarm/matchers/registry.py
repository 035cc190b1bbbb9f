"""The registry: matchers by name, built in or added by other packages through entry points.

A package adds one with an entry point in the group `orthoswarm.matchers` whose value is a callable without arguments
that returns a PictureMatcher or a MapMatcher:

    [project.entry-points."orthoswarm.matchers"]
    mine = "my_package:MyMatcher"
"""

from collections.abc import Callable
from functools import partial
from importlib.metadata import entry_points
from typing import Any

from orthoswarm.matchers.matcher import MapMatcher, PictureMatcher, UnavailableError
from orthoswarm.model.errors import InputError

GROUP = "orthoswarm.matchers"
PICTURE_ORDER = ("xfeat", "sift")  # default matcher of pictures: the first of these that is available
MAP_ORDER = ("xfeat-window", "cfog")  # default matcher of patches on the map: the first of these that is available


def _learned(kind: Any, device: str) -> PictureMatcher:
    from orthoswarm.matchers.sparse_learned import Learned

    return Learned.make(kind, device)


def _sift(_: str) -> PictureMatcher:
    from orthoswarm.matchers.sift import Sift

    return Sift()


def _window(device: str) -> MapMatcher:
    from orthoswarm.matchers.dense_window import XFeatWindow

    return XFeatWindow.make(device)


def _cfog(_: str) -> MapMatcher:
    from orthoswarm.matchers.cfog import Cfog

    return Cfog()


def _roma(device: str) -> MapMatcher:
    from orthoswarm.matchers.roma import Roma

    return Roma.make(device)


PICTURE: dict[str, Callable[[str], PictureMatcher]] = {
    **{kind: partial(_learned, kind) for kind in ("xfeat", "disk", "aliked")},
    "sift": _sift,
}
MAP: dict[str, Callable[[str], MapMatcher]] = {"xfeat-window": _window, "cfog": _cfog, "roma": _roma}


def picture_matcher(name: str | None = None, device: str = "auto") -> PictureMatcher:
    """A matcher of pictures by name; without a name the first available of PICTURE_ORDER, on a `network_device`.

    Raises InputError: if the name is unknown, or its weights or packages are missing.
    """
    matcher: PictureMatcher = _get(name, PICTURE, PICTURE_ORDER, device)
    return matcher


def map_matcher(name: str | None = None, device: str = "auto") -> MapMatcher:
    """A matcher of patches on the map by name; without a name the first available of MAP_ORDER, on a `network_device`.

    Raises InputError: if the name is unknown, or its weights or packages are missing.
    """
    matcher: MapMatcher = _get(name, MAP, MAP_ORDER, device)
    return matcher


def available() -> dict[str, str]:
    """Every matcher, built in or added, with the reason why it cannot be used (empty: it can)."""
    out = {}
    for name, make in {**PICTURE, **MAP, **_added()}.items():
        try:
            make("auto")
            out[name] = ""
        except UnavailableError as error:
            out[name] = str(error)
        except Exception as error:  # code of other packages may raise anything
            out[name] = f"it cannot be loaded ({type(error).__name__}: {error})"
    return out


def _added() -> dict[str, Callable[[str], Any]]:
    """Matchers of other packages."""
    return {point.name: _entry(point) for point in entry_points(group=GROUP)}


def _entry(point: Any) -> Callable[[str], Any]:
    return lambda _: point.load()()


def _get(name: str | None, own: dict[str, Any], order: tuple[str, ...], device: str) -> Any:
    if name is None:
        for candidate in order:
            try:
                return own[candidate](device)
            except UnavailableError:
                continue
        raise InputError(f"no matcher is available; one of {', '.join(order)} is needed")
    known = {**own, **_added()}
    if name not in known:
        raise InputError(f"there is no matcher '{name}'; choose one of {', '.join(sorted(known))}")
    try:
        return known[name](device)
    except UnavailableError as error:
        raise InputError(f"the matcher '{name}' cannot be used: {error}") from None
