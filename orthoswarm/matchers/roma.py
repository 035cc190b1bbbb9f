"""RoMa (Edstedt et al., CVPR 2024), the paper's dense matcher: an optional extra; the user supplies its weights.

`pip install orthoswarm[roma]`, then `orthoswarm weights import` of roma_outdoor.pth and dinov2_vitl14_pretrain.pth.
On a CPU one match at 560 pixels takes about a minute; on a GPU half a second.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from inspect import signature
from typing import Any, Final

import numpy as np

from orthoswarm.matchers.matcher import Floats, Mask, Matches, UnavailableError
from orthoswarm.matchers.network_device import network_device
from orthoswarm.matchers.sparse_learned import read_state

_SAMPLES: Final = 4000  # matches drawn from the dense warp (cost)
_COARSE_PX: Final = 560  # side of the picture of the coarse match (Edstedt et al., CVPR 2024)
_FINE_PX: Final = 864  # side of the picture of the refinement (the same)
_ROMA_CERTAINTY: Final = 0.3  # least certainty of a match


def load(state: dict[str, Any], backbone: dict[str, Any], device: Any) -> Any:
    """The network from its own state and that of its DINOv2 backbone, on a torch device.

    Raises UnavailableError: if the package is missing or the states do not fit it.
    """
    try:
        from romatch import roma_outdoor
    except ImportError as error:
        raise UnavailableError(f"the package romatch is missing ({error.name}); pip install orthoswarm[roma]") from None
    except RuntimeError as error:  # a torchvision built for another torch
        raise UnavailableError(
            f"torchvision does not fit torch ({error}); install the pair that belongs together"
        ) from None
    import torch

    on_gpu = device.type == "cuda"
    options = {
        "coarse_res": _COARSE_PX,
        "upsample_res": _FINE_PX,
        "amp_dtype": torch.float16 if on_gpu else torch.float32,
        "use_custom_corr": on_gpu and find_spec("local_corr") is not None,  # a CUDA extension of its own
    }
    known = signature(roma_outdoor).parameters  # older releases have fewer
    try:
        return roma_outdoor(
            device=device,
            weights=state,
            dinov2_weights=backbone,
            **{k: v for k, v in options.items() if k in known},
        )
    except (RuntimeError, KeyError) as error:
        first = str(error).splitlines()[0]
        raise UnavailableError(f"the weights do not fit RoMa ({first}); import the published files again") from None


@lru_cache(maxsize=1)
def _network(device: Any) -> Any:
    return load(read_state("roma"), read_state("roma-dinov2"), device)


@dataclass(frozen=True, slots=True)
class Roma:
    """Patch to map by RoMa: the patch against the window, matches beyond the reach dropped."""

    network: Any  # something with `match(image, image)`, `sample(warp, certainty)` and `to_pixel_coordinates`
    device: str = "auto"  # where it runs, see `network_device`

    @classmethod
    def make(cls, device: str) -> "Roma":
        """A matcher with the weights of this machine.

        Raises UnavailableError: if the package or the weights are missing.
        """
        return cls(_network(network_device(device)), device)

    def match(self, patch: Floats, valid: Mask, window: Floats, known: Mask, reach: int) -> Matches:
        """See MapMatcher."""
        from PIL import Image

        first, second = (Image.fromarray(np.clip(g, 0, 255).astype(np.uint8)).convert("RGB") for g in (patch, window))
        warp, certainty = self.network.match(first, second, device=network_device(self.device))
        found, sure = self.network.sample(warp, certainty, num=_SAMPLES)
        a, b = self.network.to_pixel_coordinates(found, *patch.shape, *window.shape)
        a, b = (t.detach().cpu().numpy().astype(np.float64) - 0.5 for t in (a, b))  # its pixel corners are integers
        score = sure.detach().cpu().numpy().astype(np.float64)
        near = np.abs(b - a - reach).max(1) <= reach
        c, r = np.clip(np.round(a), 0, np.array(patch.shape)[::-1] - 1).astype(np.int64).T
        return Matches(a, b, score).take(near & (score >= _ROMA_CERTAINTY) & valid[r, c])
