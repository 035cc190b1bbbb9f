"""How well changed ground is found on simulated cities, and the fit of the weights that it is found with.

    orthoswarm twin make debris --disaster collapse --seed 43 --out SET
    orthoswarm mosaic SET/photos --basemap SET/basemap.tif --out SET/out
    python -m benchmarks.accuracy.change measure SET... [--maps same season hour ...]
    python -m benchmarks.accuracy.change fit SET... [--weights FILE]

Each set is compared with its own map and with others made of it: another season and sensor, darker, other detail
(plants, cars and ruts of another year), averaged to 1 and 3 m a pixel, distorted by up to 3 m. Changed is what the
twin's disaster struck; haze has changed nothing. A line a set and map: average precision by cell; objects of 100 m2 and
more that were found (a quarter of their cells at least); the share of unchanged ground that is called changed at
p = 0.5, and such objects a square kilometre; how far the changed ground's outline lies from the true one (median); the
share that is really changed of cells stated at 0 to 20 %, ... 80 to 100 %. `fit` takes sets of other seeds than those
that are measured. `draw SET:EAST,NORTH,SIDE ... --out FILE.jpg` puts before, after, what was found (by `orthoswarm
change SET/out --out SET/out`) and the truth side by side, of places in metres from the middle of the map.
"""

import argparse
import json
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import rasterio

from benchmarks.accuracy.other_dates import KINDS
from benchmarks.robustness.wrong_maps import altered, averaged, darkened, season
from orthoswarm.change import evidence
from orthoswarm.change.change_files import overlay_pixels
from orthoswarm.change.change_map import cells_of, map_change, measured_blocks
from orthoswarm.change.changed_objects import LEAST_M2, find_objects
from orthoswarm.change.of_folder import WANT_M, scene_of
from orthoswarm.coverage.map_folder import read_map

LARGE_M2 = 100.0
HIDDEN = 12  # sigmoids of the likelihood
SAMPLES = 40_000  # cells of each set and map for the fit
CASE = {"water": 1, "debris": 2, "collapse": 3}


def distorted(picture, gsd_m, most_m=3.0):
    """A map whose ground lies up to some metres beside its place, smoothly."""
    random = np.random.default_rng(4)
    rows, columns = picture.shape[1:]
    shift = [
        cv2.resize(random.uniform(-1, 1, (rows // 400 + 3, columns // 400 + 3)).astype(np.float32), (columns, rows),
                   interpolation=cv2.INTER_CUBIC) * (most_m / gsd_m / 1.4)
        for _ in range(2)
    ]  # fmt: skip
    row, column = np.indices((rows, columns), np.float32)
    return np.stack([cv2.remap(b, column + shift[0], row + shift[1], cv2.INTER_LINEAR) for b in picture])


MAPS: dict[str, Callable] = {
    "same": shutil.copyfile, "season": partial(altered, change=season), "darker": partial(altered, change=darkened),
    "detail": partial(altered, change=KINDS["half of the detail"]),
    "all detail": partial(altered, change=KINDS["all detail, another season"]),
    "distorted": partial(altered, change=distorted),
    "1 m": partial(averaged, gsd_m=1.0), "3 m": partial(averaged, gsd_m=3.0),
}  # fmt: skip


def scene(folder, kind):
    """The scene of a set with a kind of map, and its views."""
    path = folder / f"basemap-{kind.replace(' ', '-')}.tif"
    MAPS[kind](folder / "basemap.tif", path)
    flown = read_map(folder / "out")
    return scene_of(folder / "out", flown, basemap=path)[0], flown


def truth(folder, grid):
    """The case of each cell: what the disaster struck, 0 elsewhere; uint8."""
    disaster = json.loads((folder / "truth" / "manifest.json").read_text())["disaster"]
    out = np.zeros((grid.height, grid.width), np.uint8)
    if disaster in CASE:
        with rasterio.open(folder / "truth" / "disaster_mask.tif") as file:
            window = rasterio.windows.from_bounds(*grid.bounds, file.transform)
            mask = file.read(1, window=window, boundless=True, fill_value=0, out_shape=out.shape,
                             resampling=rasterio.enums.Resampling.average)  # fmt: skip
        out[mask > 127] = CASE[disaster]
    return out


def average_precision(score, changed):
    """Area under precision over recall."""
    changed = changed[np.argsort(-score.astype(np.float32), kind="stable")]
    hits = np.cumsum(changed)
    return float((hits / np.arange(1, len(changed) + 1))[changed].mean()) if changed.any() else None


def measure(folder, kind):
    """A row of the table."""
    compared, flown = scene(folder, kind)
    start = time.process_time()
    found = map_change(compared, want_m=WANT_M)
    objects = find_objects(found, flown.views, flown.ground_z_m)
    cpu = time.process_time() - start
    case = truth(folder, found.grid)
    cell_m2 = found.grid.gsd_m**2
    seen, stated = found.visible, found.probability > 127
    changed = case > 0
    count, label, stats, _ = cv2.connectedComponentsWithStats((changed & seen).astype(np.uint8), connectivity=8)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] * cell_m2 >= LARGE_M2]
    hit = np.bincount(label[stated & seen], minlength=count)
    number, blob, sizes, _ = cv2.connectedComponentsWithStats((stated & seen).astype(np.uint8), connectivity=8)
    true = np.bincount(blob[cv2.dilate(changed.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0], minlength=number)
    area = sizes[:, cv2.CC_STAT_AREA]
    false = sum(true[k] < 0.1 * area[k] for k in range(1, number) if area[k] * cell_m2 >= LEAST_M2)
    chance = found.probability[seen] / 255.0
    bins = np.minimum((chance * 5).astype(int), 4)
    kinds: dict[str, float] = {}
    for one in objects:
        kinds[one.kind] = kinds.get(one.kind, 0.0) + one.area_m2
    return {
        "set": folder.name, "map": kind,
        "precision": average_precision(found.probability[seen], changed[seen]),
        "objects": len(large),
        "found": round(sum(hit[k] >= 0.25 * stats[k, cv2.CC_STAT_AREA] for k in large) / max(len(large), 1), 3),
        "false_share": round(float((stated & ~changed)[seen].sum() / max((~changed)[seen].sum(), 1)), 4),
        "false_km2": round(float(false) / (seen.sum() * cell_m2 / 1e6), 1),
        "outline_m": outline_distance(stated & seen, changed & seen) * found.grid.gsd_m if large else None,
        "reliability": [
            round(float(changed[seen][bins == k].mean()), 2) if (bins == k).any() else None for k in range(5)
        ],
        "not_visible": round(1 - seen.sum() / found.inside.sum(), 3), "kinds": {k: round(v) for k, v in kinds.items()},
        "cpu_s": round(cpu, 2),
    }  # fmt: skip


def outline_distance(stated, changed):
    """Median distance of the stated outline of large areas from the true one, cells."""

    def outline(mask):
        opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
        return opened != cv2.erode(opened, np.ones((3, 3), np.uint8))

    own, true = outline(stated), outline(changed)
    if not own.any() or not true.any():
        return float("nan")
    return round(float(np.median(cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, 5)[own])), 2)


def fit(folders, kinds, target):
    """Fit the weights by maximum likelihood and write them."""
    import torch

    random = np.random.default_rng(0)
    values, cases = [], []
    for folder in folders:
        for kind in kinds:
            compared, _ = scene(folder, kind)
            grid = cells_of(compared, WANT_M)
            case = truth(folder, grid)
            own, of = [], []
            for block in measured_blocks(compared, grid):
                good = block.drawn & (block.seen > 0.5) & ~block.hidden
                own.append(block.values[good])
                of.append(case[block.rows, block.columns][good])
            x, y = np.concatenate(own), np.concatenate(of)
            k = random.choice(len(x), min(len(x), SAMPLES * (3 if (y == CASE["collapse"]).any() else 1)), replace=False)
            values.append(x[k])
            cases.append(y[k])
            print(folder.name, kind, len(k), flush=True)
    x, y = np.concatenate(values), np.concatenate(cases)
    mean, spread = x.mean(0), x.std(0) + 1e-6
    inputs, wanted = (
        torch.tensor(np.clip((x - mean) / spread, -evidence.MOST, evidence.MOST)),
        torch.tensor(y).long(),
    )
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(x.shape[1], HIDDEN), torch.nn.Tanh(), torch.nn.Linear(HIDDEN, 4))
    steps = torch.optim.Adam(net.parameters(), 5e-3, weight_decay=1e-5)
    rounds = 20
    for done in range(rounds):
        steps.param_groups[0]["lr"] = 2.5e-3 * (1 + np.cos(np.pi * done / rounds)) + 1e-4
        for part in torch.randperm(len(inputs)).split(4096):
            loss = torch.nn.functional.cross_entropy(net(inputs[part]), wanted[part])
            steps.zero_grad()
            loss.backward()
            steps.step()
    layers = [np.vstack([net[k].weight.detach().numpy().T, net[k].bias.detach().numpy()[None]]) for k in (0, 2)]
    np.savez_compressed(target, mean=mean, spread=spread, first=layers[0], second=layers[1])


PX = 260
TRUE = (0, 190, 255)


def window(path, bounds, bands):
    """A part of a raster, PX square."""
    with rasterio.open(path) as file:
        part = rasterio.windows.from_bounds(*bounds, file.transform)
        data = file.read(bands, window=part, boundless=True, fill_value=0)
    return cv2.resize(np.moveaxis(data, 0, 2), (PX, PX), interpolation=cv2.INTER_AREA)


def row(text):
    """The four pictures of a part."""
    name, _, place = text.rpartition(":")
    folder, (east, north, side) = Path(name), (float(v) for v in place.split(","))
    with rasterio.open(folder / "out" / "change.tif") as file:
        box = file.bounds
    east, north = east + (box.left + box.right) / 2, north + (box.bottom + box.top) / 2
    bounds = (east - side / 2, north - side / 2, east + side / 2, north + side / 2)
    before = window(folder / "basemap.tif", bounds, (1, 2, 3))
    after = window(folder / "out" / "orthoimage.tif", bounds, (1, 2, 3))
    paint, _ = overlay_pixels(folder / "out", 0.5, bounds, (PX, PX))
    share = paint[..., 3:] / 255.0
    shown = np.round(after * (1 - share) + paint[..., :3] * share).astype(np.uint8)
    real = after.copy()
    truth = folder / "truth" / "disaster_mask.tif"
    if truth.exists():
        mask = (window(truth, bounds, [1]).reshape(PX, PX) > 127).astype(np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(real, outlines, -1, TRUE, 2)
    gap = np.full((PX, 6, 3), 255, np.uint8)
    return np.hstack([before, gap, after, gap, shown, gap, real])


def draw(parts, target):
    """Write the pictures of all parts, one below the other."""
    rows = [row(part) for part in parts]
    gap = np.full((6, rows[0].shape[1], 3), 255, np.uint8)
    picture = np.vstack([part for one in rows for part in (one, gap)][:-1])
    cv2.imwrite(str(target), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 70])


def main() -> None:
    """Measure, fit or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measure", "fit", "draw"))
    parser.add_argument("sets", nargs="+", metavar="SET")
    parser.add_argument("--maps", nargs="+", choices=MAPS, default=None)
    parser.add_argument("--weights", type=Path, default=Path(evidence.__file__).with_name("weights.npz"))
    parser.add_argument("--out", type=Path, default=Path("change.jpg"))
    args = parser.parse_args()
    if args.what == "draw":
        draw(args.sets, args.out)
        return
    folders = [Path(name) for name in args.sets]
    if args.what == "fit":
        fit(folders, args.maps or ["same", "season", "darker", "all detail", "3 m"], args.weights)
        return
    for folder in folders:
        for kind in args.maps or MAPS:
            print(json.dumps(measure(folder, kind)), flush=True)


if __name__ == "__main__":
    main()
