"""Tones of an orthoimage: steps across its seams, its facets, its sharpness, and its error against the true picture.

    orthoswarm mosaic SET/photos --out OUT
    python -m benchmarks.accuracy.tones OUT [--truth SET/truth/reference.tif] [--picture OUT/contrast.png]

For each seam between two photos (`seamlines.gpkg`) the mean brightness of strips to either side is compared; strips are
1.5 m wide, seams shorter than 5 m do not count. Printed, for all ground and for even ground, in grey levels of 255 and
weighed by length: median and 95 % of the absolute step, and the same across lines of the same shapes 6 m beside the
seams: so much the ground itself changes, and a seam that steps no more cannot be told from it. Sharpness is the mean
absolute Laplacian away from seams. Against the truth: root mean square and 95 % of the log ratio of means over 10 m,
less its median. The picture shows means over 3 m, less those over 60 m, times 10.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import pyogrio
import rasterio
from rasterio.enums import Resampling
from rasterio.features import rasterize
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_geom
from shapely import from_wkb
from shapely.geometry import mapping

_STRIP_M, _SEAM_M, _BESIDE_M, _LOW_M, _BLOCK_M, _WIDE_M = 1.5, 5.0, 6.0, 3.0, 10.0, 60.0
_EVEN = 8.0
"""Ground is even where the standard deviation across a strip is less, in grey levels: steps show there."""
_PIXEL_M = 0.25
"""Coarser than this the steps are measured on; finer orthoimages are averaged."""


def main() -> None:
    """Print the figures of an orthoimage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of a run")
    parser.add_argument("--truth", type=Path, help="true picture of the ground")
    parser.add_argument("--picture", type=Path, help="write the contrast picture here")
    args = parser.parse_args()
    rgb, mask, labels, transform, crs = _read(args.out)
    pixel = transform.a
    for ground, limit in (("all ground", np.inf), ("even ground", _EVEN)):
        grey, drawn = rgb.mean(2), np.where(mask, labels, 0)
        at = [seam_steps(grey, drawn, pixel, limit)]
        if not len(at[0][0]):
            continue
        by = round(_BESIDE_M / pixel)
        shifts = ((0, by), (0, -by), (by, 0), (-by, 0))
        beside = [seam_steps(grey, np.where(mask, np.roll(drawn, s, (0, 1)), 0), pixel, limit) for s in shifts]
        (middle, most), (plain, plain_most) = _quantiles(at), _quantiles(beside)
        print(
            f"{ground}: steps of {len(at[0][0])} seams: median {middle:.2f}, 95 % {most:.2f} grey levels"
            f" (beside the seams {plain:.2f}, {plain_most:.2f})"
        )
    print(f"sharpness {sharpness(rgb.mean(2), mask, labels):.2f}")
    if args.truth:
        with (
            rasterio.open(args.truth) as file,
            WarpedVRT(
                file,
                crs=crs,
                transform=transform,
                width=mask.shape[1],
                height=mask.shape[0],
                resampling=Resampling.average,
                add_alpha=file.count == 3,
            ) as warped,
        ):
            true = np.moveaxis(warped.read([1, 2, 3]), 0, 2).astype(np.float32)
            both = mask & (warped.dataset_mask() > 0) & (true.min(2) > 5) & (rgb.min(2) > 5)
        log = np.log(np.maximum(rgb, 1)).mean(2) - np.log(np.maximum(true, 1)).mean(2)
        low, share = _means(log, both, _BLOCK_M / pixel)
        error = low[share > 0.9] - np.median(low[share > 0.9])
        print(
            f"against the truth: rms {np.sqrt((error**2).mean()):.4f}, 95 % {np.quantile(np.abs(error), 0.95):.4f} log"
        )
    if args.picture:
        channels = []
        for channel in range(3):
            low, _ = _means(rgb[..., channel], mask, _LOW_M / pixel)
            wide, _ = _means(rgb[..., channel], mask, _WIDE_M / pixel)
            channels.append(np.where(mask, np.clip(128 + 10 * (low - wide), 0, 255), 0))
        cv2.imwrite(str(args.picture), np.stack(channels[::-1], 2).astype(np.uint8))


def seam_steps(grey, labels, pixel, limit):
    """Absolute steps between photos, and the lengths in metres of their seams.

    Args:
        grey: float32 (H, W). labels: int32 (H, W), 0 where nothing was drawn. pixel: metres. limit: greatest
            standard deviation of the grey levels within a strip.
    """
    wide = max(2, round(_STRIP_M / pixel))
    found: dict[int, list[np.ndarray]] = {}
    for value, label in ((grey, labels), (grey.T, labels.T)):
        columns = label.shape[1] - 2 * wide
        part = [label[:, k : k + columns + 1] for k in range(2 * wide)]
        seam = (part[wide - 1] != part[wide]) & (part[0] > 0) & (part[-1] > 0)
        for k in range(2 * wide):
            seam &= part[k] == part[0 if k < wide else -1]
        sums = np.cumsum(np.pad(value.astype(np.float64), ((0, 0), (1, 0))), axis=1)
        means = (sums[:, wide:] - sums[:, :-wide]) / wide
        squares = np.cumsum(np.pad(value.astype(np.float64) ** 2, ((0, 0), (1, 0))), axis=1)
        variance = (squares[:, wide:] - squares[:, :-wide]) / wide - means**2
        seam &= np.maximum(variance[:, wide:], variance[:, :-wide]) < limit**2
        step = (means[:, wide:] - means[:, :-wide])[seam]
        one, other = part[0][seam].astype(np.int64), part[-1][seam].astype(np.int64)
        step = np.where(one < other, step, -step)
        key = np.minimum(one, other) * (labels.max() + 1) + np.maximum(one, other)
        order = np.argsort(key, kind="stable")
        keys, first = np.unique(key[order], return_index=True)
        for pair, values in zip(keys, np.split(step[order], first[1:])):
            found.setdefault(int(pair), []).append(values)
    together = [np.concatenate(v) for v in found.values()]
    together = [v for v in together if len(v) * pixel >= _SEAM_M]
    return np.array([abs(v.mean()) for v in together]), np.array([len(v) * pixel for v in together])


def sharpness(grey, mask, labels):
    """Mean absolute Laplacian where one photo is drawn all round."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    high, low = (f(labels.astype(np.float32), np.ones((7, 7), np.uint8)) for f in (cv2.dilate, cv2.erode))
    return float(np.abs(cv2.Laplacian(grey.astype(np.float32), cv2.CV_32F))[inside & (high == low)].mean())


def _read(out):
    """Colours (H, W, 3), what was drawn, photos (index + 1), transform and reference system of a run's orthoimage."""
    with rasterio.open(out / "orthoimage.tif") as file:
        ratio = max(1.0, _PIXEL_M / file.res[0])
        height, width = int(file.height / ratio), int(file.width / ratio)
        image = file.read(out_shape=(4, height, width), resampling=Resampling.average)
        transform = file.transform * file.transform.scale(file.width / width, file.height / height)
        crs = file.crs
    meta, _, outlines, _ = pyogrio.raw.read(out / "seamlines.gpkg")
    shapes = [(transform_geom(meta["crs"], crs, mapping(from_wkb(wkb))), k + 1) for k, wkb in enumerate(outlines)]
    labels = rasterize(shapes, out_shape=(height, width), transform=transform, dtype=np.int32)
    return np.moveaxis(image[:3], 0, 2).astype(np.float32), image[3] == 255, labels, transform, crs


def _quantiles(found):
    """Median and 95 % of steps, weighed by length; found: pairs of steps and lengths."""
    step, length = (np.concatenate(parts) for parts in zip(*found))
    order = np.argsort(step)
    share = np.cumsum(length[order]) / length.sum()
    return [step[order[min(int(np.searchsorted(share, q)), len(order) - 1)]] for q in (0.5, 0.95)]


def _means(values, mask, side):
    """Means over squares of what was drawn, and the share of it."""
    size = (round(side) | 1,) * 2
    share = cv2.blur(mask.astype(np.float32), size)
    return cv2.blur(np.where(mask, values, 0).astype(np.float32), size) / np.maximum(share, 1e-3), share


if __name__ == "__main__":
    main()
