"""Which pictures are blurred, damaged or without contrast, by comparison with their neighbours in flight."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.coverage.view import Flaw
from orthoswarm.raster.picture_quality import PictureQuality

NEIGHBOURS: Final = 15  # pictures before and after with whose median one is compared
_BLURRED_SHARE: Final = 0.5  # blurred: less than this share of their sharpness
_FAINT_SHARE: Final = 0.25  # haze: less than this share of their contrast ...
_LEAST_CONTRAST: Final = 4.0  # ... or less than this ...
_SATURATED_SHARE: Final = 0.5  # ... or more than this share of the pixels saturated
_FLAT_SHARE: Final = 0.10  # damaged: this share of the blocks more than usual is of one single value


def picture_flaws(qualities: Sequence[PictureQuality | None]) -> list[Flaw]:
    """Flaws of one camera's pictures, in flying order; none for a picture that was not measured.

    Blurred: less than half as sharp as the median of the 15 pictures before and after. Haze: less than a quarter of
    their median contrast, or less than 4 grey levels, or half of the pixels saturated. Damaged: the share of blocks of
    one single value exceeds their median by a tenth. The thresholds are ours; sharpness over a wood and over a lake
    differs by less.
    """
    flaws = [Flaw(0)] * len(qualities)
    measured = [i for i, q in enumerate(qualities) if q is not None]
    if not measured:
        return flaws
    rows = [(q.sharpness, q.contrast, q.flat_share, q.saturated_share) for q in qualities if q is not None]
    sharp, contrast, flat, bright = np.array(rows, float).T
    usual_sharp, usual_contrast, usual_flat = (_running_median(v) for v in (sharp, contrast, flat))
    for k, i in enumerate(measured):
        if sharp[k] < _BLURRED_SHARE * usual_sharp[k]:
            flaws[i] |= Flaw.BLURRED
        if contrast[k] < max(_LEAST_CONTRAST, _FAINT_SHARE * usual_contrast[k]) or bright[k] > _SATURATED_SHARE:
            flaws[i] |= Flaw.HAZE
        if flat[k] > usual_flat[k] + _FLAT_SHARE:
            flaws[i] |= Flaw.DAMAGED
    return flaws


def _running_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    n = NEIGHBOURS
    return np.array([np.median(values[max(0, i - n) : i + n + 1]) for i in range(len(values))])
