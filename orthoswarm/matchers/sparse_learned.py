"""Sparse learned matchers through kornia: XFeat + LighterGlue, DISK + LightGlue, ALIKED + LightGlue.

Weights are read from local files (weight_files.py). Pictures are padded to the networks' strides instead of
being resized or cropped, which would shift keypoints by fractions of a pixel.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np

from orthoswarm.matchers import weight_files
from orthoswarm.matchers.matcher import Gray, Matches, UnavailableError
from orthoswarm.matchers.network_device import network_device

Kind = Literal["xfeat", "disk", "aliked"]
_STRIDE = {"xfeat": 32, "disk": 16, "aliked": 32}
_EXTRACTOR = {"xfeat": "xfeat", "disk": "disk", "aliked": "aliked"}
_MATCHER = {"xfeat": "xfeat-lighterglue", "disk": "disk-lightglue", "aliked": "aliked-lightglue"}

_LEARNED_KEYPOINTS: Final = 1024  # most keypoints a picture (cost)
_LEARNED_DETECTION: Final = 0.05  # detection threshold of XFeat (Potje et al., CVPR 2024)
_LEARNED_LEAST_KEYPOINTS: Final = 4  # pictures with fewer keypoints are not matched


def read_state(name: str) -> dict[str, Any]:
    """The tensors of a weight file, read without executing code that the file may contain.

    Raises UnavailableError: if the file is missing or damaged.
    """
    import torch

    path = weight_files.require(name)
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises anything from EOFError to UnpicklingError
        raise UnavailableError(f"{path} is damaged ({type(error).__name__}); copy or install it again") from None
    return state


def extractor(kind: Kind, device: str) -> Any:
    """A network that finds and describes keypoints, in evaluation mode, on `network_device(device)`."""
    return _extractor(kind, network_device(device))


@lru_cache(maxsize=3)
def _extractor(kind: Kind, device: Any) -> Any:
    import kornia.feature as features

    state = read_state(_EXTRACTOR[kind])
    if kind == "xfeat":
        model = features.XFeat()
        model.net.load_state_dict(state)
    elif kind == "disk":
        model = features.DISK()
        model.load_state_dict(state["extractor"])
    else:
        model = features.ALIKED()
        model.load_state_dict(state, strict=False)
    return model.to(device).eval()


def glue(kind: Kind, device: str) -> Any:
    """The LightGlue network for a kind of keypoints, in evaluation mode, on `network_device(device)`."""
    return _glue(kind, network_device(device))


@lru_cache(maxsize=3)
def _glue(kind: Kind, device: Any) -> Any:
    import kornia.feature as features

    settings = {k: v for k, v in features.LightGlue.features[kind].items() if k != "weights"}
    model = features.LightGlue(None, **settings)
    renamed = {}
    for key, value in read_state(_MATCHER[kind]).items():
        if key.startswith("extractor."):  # LighterGlue's file holds its XFeat, too
            continue
        name = key.removeprefix("matcher.")
        for part in ("self_attn", "cross_attn"):
            pieces = name.split(".")
            if pieces[0] == part:
                name = ".".join(["transformers", pieces[1], part, *pieces[2:]])
        renamed[name] = value
    missing, _ = model.load_state_dict(renamed, strict=False)
    if set(missing) - {"confidence_thresholds"}:
        raise UnavailableError(
            f"the weights '{_MATCHER[kind]}' do not fit LightGlue of this kornia; install kornia 0.9"
        )
    return model.to(device).eval()


def padded_tensor(gray: Gray, stride: int, device: str, channels: int = 1) -> Any:
    """A picture as a float tensor (1, channels, H, W), 0 to 1, padded with its edge to multiples of a stride."""
    import torch

    rows, cols = gray.shape
    pad = ((0, -rows % stride), (0, -cols % stride))
    image = np.pad(gray, pad, mode="edge").astype(np.float32) / 255.0
    return torch.from_numpy(image)[None, None].expand(1, channels, -1, -1).to(network_device(device))


@dataclass(frozen=True, slots=True)
class Learned:
    """Keypoints of one network, matched by LightGlue."""

    kind: Kind = "xfeat"  # which network
    device: str = "auto"  # where it runs, see `network_device`

    @classmethod
    def make(cls, kind: Kind, device: str) -> "Learned":
        """A matcher whose weights are known to be there. Raises UnavailableError: if they are not."""
        weight_files.require(_EXTRACTOR[kind])
        weight_files.require(_MATCHER[kind])
        return cls(kind, device)

    def match(self, a: Gray, b: Gray) -> Matches:
        """See PictureMatcher."""
        import torch

        with torch.inference_mode():
            one, two = self._features(a), self._features(b)
            if min(one["keypoints"].shape[1], two["keypoints"].shape[1]) < _LEARNED_LEAST_KEYPOINTS:
                return Matches.none()
            found = glue(self.kind, self.device)({"image0": one, "image1": two})
        pairs = found["matches"][0].cpu().numpy()
        score = found["scores"][0].cpu().numpy().astype(np.float64)
        first = one["keypoints"][0].cpu().numpy().astype(np.float64)
        second = two["keypoints"][0].cpu().numpy().astype(np.float64)
        return Matches(first[pairs[:, 0]], second[pairs[:, 1]], score)

    def _features(self, gray: Gray) -> dict[str, Any]:
        import torch

        count = _LEARNED_KEYPOINTS
        rows, cols = gray.shape
        image = padded_tensor(gray, _STRIDE[self.kind], self.device, 1 if self.kind == "xfeat" else 3)
        model = extractor(self.kind, self.device)
        if self.kind == "xfeat":
            found = model.detectAndCompute(image, top_k=count, detection_threshold=_LEARNED_DETECTION)[0]
            points, descriptors = found["keypoints"], found["descriptors"]
        elif self.kind == "disk":
            result = model(image, n=count)[0]
            points, descriptors = result.keypoints, result.descriptors
        else:
            result = model(image)[0]
            best = torch.argsort(result.keypoint_scores, descending=True)[:count]
            points, descriptors = result.keypoints[best], result.descriptors[best]
        inside = (points[:, 0] <= cols - 1) & (points[:, 1] <= rows - 1)  # not in the padding
        points, descriptors = points[inside].float(), descriptors[inside].float()
        size = torch.tensor([[cols, rows]], dtype=torch.float32, device=image.device)
        return {"keypoints": points[None], "descriptors": descriptors[None], "image_size": size}
