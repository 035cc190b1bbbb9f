"""Pictures of a map under plain names in one folder, linked rather than copied."""

import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from orthoswarm.export.atomic_file import disk_error

_MOST_STEM: Final = 120  # characters; file systems take names of 255 bytes


def unique_names(images: Iterable[str]) -> list[str]:
    """Plain file names without blanks for images of several folders (`v1/a b.jpg` -> `v1_a_b.jpg`), all different.

    Two vehicles may have sent pictures of the same name: each has a name of its own, in the order of the images.
    """
    images = list(images)
    heads = [image.split("/")[-1] for image in images]
    repeated = len(set(heads)) < len(heads)
    out: list[str] = []
    taken: set[str] = set()
    for image, head in zip(images, heads, strict=True):
        plain = re.sub(r"[^A-Za-z0-9._-]", "_", image if repeated else head)
        stem, suffix = os.path.splitext(plain)
        if not suffix or not re.fullmatch(r"\.(jpe?g|png|tiff?)", suffix.lower()):
            stem, suffix = plain, ".jpg"
        stem = stem[:_MOST_STEM]
        name, number = stem + suffix, 1
        while name.lower() in taken:
            number += 1
            name = f"{stem}_{number}{suffix}"
        taken.add(name.lower())
        out.append(name)
    return out


def link_file(file: Path, target: Path) -> None:
    """Link a file under another name, or copy it if the file system has no links.

    Raises:
        FileExistsError: the name is taken. A copy there would be written into the file that it is linked to.
    """
    try:
        os.link(file, target)
    except FileExistsError:
        raise
    except OSError:
        try:
            shutil.copyfile(file, target)
        except OSError as error:
            raise disk_error(error, target) from None
