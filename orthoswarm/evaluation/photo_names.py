"""Photos by the names that tables of points, of true cameras or of other programs give them."""

from collections.abc import Collection

from orthoswarm.model.errors import InputError


def photos_named(known: Collection[str], image: str) -> list[str]:
    """The photos that a name may stand for: of the two paths one has to be the end of the other.

    A table may leave out folders that the product names have, or write folders that these lack.

    Args:
        known: names of the photos, folders separated by slashes. image: name to look up.

    Returns:
        One name where the match is certain (upper and lower case as written), else all that fit in any case.
    """
    parts = image.replace("\\", "/").split("/")
    for k in range(len(parts)):
        tail = "/".join(parts[k:])
        if tail in known:
            return [tail]
    path = "/" + "/".join(parts).lower()
    return [name for name in known if f"/{name.lower()}".endswith(path) or path.endswith(f"/{name.lower()}")]


def photo_named(known: Collection[str], image: str) -> str | None:
    """The photo of a name (see `photos_named`), None if there is none.

    Raises InputError: several photos have that name.
    """
    found = photos_named(known, image)
    if len(found) > 1:
        raise InputError(f"{len(found)} photos are called {image}; write them with their folders")
    return found[0] if found else None
