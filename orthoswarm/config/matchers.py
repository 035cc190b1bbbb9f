"""Matchers of pictures and of patches to the map."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchersConfig:
    """Matchers of pictures and of patches to the map."""

    device: str = "auto"
    """Where networks run: "cpu", "cuda", or "auto", a CUDA card where there is one (a match by RoMa takes a minute on
    a CPU and half a second on a card)."""

    # Learned keypoints and RoMa

    roma_samples: int = 4000
    """Matches drawn from the dense warp (chosen for cost)."""
    roma_coarse_px: int = 560
    """Side of the picture of the coarse match, pixels (Edstedt et al., CVPR 2024)."""
    roma_fine_px: int = 864
    """Side of the picture of the refinement, pixels (Edstedt et al., CVPR 2024)."""
