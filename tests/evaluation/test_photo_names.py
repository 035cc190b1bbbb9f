"""Photos looked up by the names that tables give them."""

import pytest

from orthoswarm.evaluation.photo_names import photo_named
from orthoswarm.model.errors import InputError

KNOWN = ("v1/a.jpg", "v2/a.jpg", "v2/B.JPG")


@pytest.mark.parametrize(
    ("written", "photo"),
    [
        ("v1/a.jpg", "v1/a.jpg"),
        ("survey\\v2\\a.jpg", "v2/a.jpg"),  # more folders than the product, in Windows' way
        ("b.jpg", "v2/B.JPG"),  # fewer, and in small letters
        ("v3/a.jpg", None),  # another vehicle's
        ("c.jpg", None),
    ],
)
def test_a_photo_is_found_when_one_path_is_the_end_of_the_other(written, photo):
    assert photo_named(KNOWN, written) == photo


def test_a_name_that_several_photos_have_needs_its_folder():
    with pytest.raises(InputError, match="2 photos are called"):
        photo_named(KNOWN, "a.jpg")
