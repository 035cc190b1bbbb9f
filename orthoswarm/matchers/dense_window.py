"""Dense XFeat descriptors matched in the prior window; finds real before/after pairs where keypoints fail.

Every cell of 8 x 8 pixels of the patch is compared with the map's cells at all shifts that the poses allow. Scores
are averaged over neighbouring cells, which have nearly the same shift, before the best shift of a cell is chosen.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from orthoswarm.matchers import weight_files
from orthoswarm.matchers.matcher import Floats, Gray, Mask, Matches
from orthoswarm.matchers.network_device import network_device
from orthoswarm.matchers.sparse_learned import extractor, padded_tensor
from orthoswarm.raster.subpixel_peak import vertices

CELL_PX = 8
_STRIDE = 32

_WINDOW_NEIGHBOURS: Final = 5  # side of the square of cells whose scores are averaged
_WINDOW_CONTRAST: Final = 4.0  # best shift's score exceeds the mean of its cell's scores by so many standard deviations
_WINDOW_SURE_CONTRAST: Final = 10.0  # contrast from which on a match has the score 1
_WINDOW_LEAST_CELLS: Final = 4  # least number of cells that are averaged
_WINDOW_LEAST_SIDE: Final = 3  # least side of a patch in cells
_WINDOW_VALID_SHARE: Final = 0.8  # least share of valid pixels in a cell
_WINDOW_PART_CELLS: Final = 96  # side of the square of cells that the network describes at once (memory)
_WINDOW_MARGIN_CELLS: Final = 12  # cells around them that it is given as well: about its receptive field


@dataclass(frozen=True, slots=True)
class XFeatWindow:
    """Patch to map by dense XFeat descriptors; device: where its network runs, see `network_device`."""

    device: str = "auto"

    @classmethod
    def make(cls, device: str) -> "XFeatWindow":
        """A matcher whose weights are known to be there. Raises UnavailableError: if they are not."""
        weight_files.require("xfeat")
        return cls(device)

    def match(self, patch: Floats, valid: Mask, window: Floats, known: Mask, reach: int) -> Matches:
        """See MapMatcher."""
        steps = reach // CELL_PX
        rows, cols = patch.shape[0] // CELL_PX, patch.shape[1] // CELL_PX
        if steps < 1 or min(rows, cols) < _WINDOW_LEAST_SIDE:
            return Matches.none()
        spare = reach - steps * CELL_PX  # cells of both on one grid
        own, own_ok = _described(patch, valid, self.device)
        other, other_ok = _described(window[spare:, spare:], known[spare:, spare:], self.device)
        own, own_ok = own[:, :rows, :cols], own_ok[:rows, :cols]
        height, width = rows + 2 * steps, cols + 2 * steps
        if other.shape[1] < height or other.shape[2] < width or not own_ok.any():
            return Matches.none()
        score = self._scores(own, own_ok, other, other_ok, steps)
        return self._best(score, own_ok, steps, spare)

    def _scores(self, own: Any, own_ok: Mask, other: Any, other_ok: Mask, steps: int) -> Floats:
        """Similarity of each cell at each shift, float32 (2 steps + 1, 2 steps + 1, rows, columns)."""
        import cv2
        import torch

        n = 2 * steps + 1
        rows, cols = own_ok.shape
        out = np.zeros((n, n, rows, cols), np.float32)
        side = (_WINDOW_NEIGHBOURS, _WINDOW_NEIGHBOURS)
        with torch.inference_mode():
            for dr in range(n):
                for dc in range(n):
                    both = own_ok & other_ok[dr : dr + rows, dc : dc + cols]
                    dot = (own * other[:, dr : dr + rows, dc : dc + cols]).sum(0).cpu().numpy()
                    total = cv2.boxFilter(np.where(both, dot, 0.0).astype(np.float32), -1, side, normalize=False)
                    count = cv2.boxFilter(both.astype(np.float32), -1, side, normalize=False)
                    out[dr, dc] = np.where(count >= _WINDOW_LEAST_CELLS, total / np.maximum(count, 1.0), 0.0)
        return out

    def _best(self, score: Floats, own_ok: Mask, steps: int, spare: int) -> Matches:
        """The clear best shift of each cell, refined between shifts by parabolas."""
        n, _, rows, cols = score.shape
        flat = score.reshape(n * n, rows, cols)
        best = flat.argmax(0)
        peak = flat.max(0)
        contrast = (peak - flat.mean(0)) / np.maximum(flat.std(0), 1e-6)
        at_r, at_c = best // n, best % n
        inside = (at_r > 0) & (at_r < n - 1) & (at_c > 0) & (at_c < n - 1)
        rr, cc = np.nonzero(own_ok & inside & (contrast >= _WINDOW_CONTRAST))
        if not len(rr):
            return Matches.none()
        r, c = at_r[rr, cc], at_c[rr, cc]
        middle = score[r, c, rr, cc]
        dr = vertices(score[r - 1, c, rr, cc], middle, score[r + 1, c, rr, cc])
        dc = vertices(score[r, c - 1, rr, cc], middle, score[r, c + 1, rr, cc])
        centre = 0.5 * (CELL_PX - 1)
        a = (np.column_stack([cc, rr]) * float(CELL_PX) + centre).astype(np.float64)
        b = a + spare + CELL_PX * np.column_stack([c + dc, r + dr])
        sure = np.clip(contrast[rr, cc] / _WINDOW_SURE_CONTRAST, 0.0, 1.0).astype(np.float64)
        return Matches(a, np.asarray(b, np.float64), sure)


def _described(gray: Floats, valid: Mask, device: str) -> tuple[Any, Mask]:
    """Unit descriptors (64, rows, columns) of cells, on the network's device, and which cells are mostly valid."""
    import cv2
    import torch

    filled = np.where(valid, gray, float(gray[valid].mean()) if valid.any() else 127.0)
    image = np.clip(filled, 0, 255).astype(np.uint8)
    rows, cols = gray.shape[0] // CELL_PX, gray.shape[1] // CELL_PX
    side = _WINDOW_PART_CELLS
    dense = torch.zeros((64, rows, cols), device=network_device(device))
    with torch.inference_mode():
        for r in range(0, rows, side):
            for c in range(0, cols, side):
                part = _part(image, r, c, device)
                dense[:, r : r + side, c : c + side] = part[:, : rows - r, : cols - c]
    share = cv2.resize(
        valid[: rows * CELL_PX, : cols * CELL_PX].astype(np.float32), (cols, rows), interpolation=cv2.INTER_AREA
    )
    return dense[:, :rows, :cols], share > _WINDOW_VALID_SHARE


def _part(image: Gray, row: int, column: int, device: str) -> Any:
    """Unit descriptors (64, <= n, <= n) of n x n cells; in parts, since the network's memory grows with the image."""
    import torch

    side, margin = _WINDOW_PART_CELLS, _WINDOW_MARGIN_CELLS
    r0, c0 = max(0, row - margin), max(0, column - margin)
    r1, c1 = row + side + margin, column + side + margin
    cut = image[r0 * CELL_PX : r1 * CELL_PX, c0 * CELL_PX : c1 * CELL_PX]
    found = extractor("xfeat", device).net(padded_tensor(cut, _STRIDE, device))[0]
    found = found[0, :, row - r0 : row - r0 + side, column - c0 : column - c0 + side]
    return torch.nn.functional.normalize(found, dim=0)
