"""The sensor model: from light to a JPEG by optics, vignetting, exposure, noise and encoding."""

import numpy as np

from orthoswarm.model.arrays import Bytes, Floats


class Sensor:
    """A small drone camera with automatic exposure.

    Args:
        width: columns; height: rows.
        seed: of the noise array; each picture uses another part of it.
    """

    def __init__(self, width: int, height: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 101])
        self._bank = rng.normal(0.0, 1.0, (height + 257, width + 263, 3)).astype(np.float32)
        x = (np.arange(width, dtype=np.float32) - 0.5 * (width - 1)) / (0.5 * width)
        y = (np.arange(height, dtype=np.float32) - 0.5 * (height - 1)) / (0.5 * width)
        self._vignette = (1.0 - 0.13 * (x[None, :] ** 2 + y[:, None] ** 2))[..., None]

    def expose(self, light: Floats, rng: np.random.Generator) -> Bytes:
        """8-bit colours of a picture: slight blur, darker corners, exposure within 4 %, noise of 2 grey values."""
        import cv2

        image = cv2.GaussianBlur(light, (0, 0), 0.42)
        image *= self._vignette * np.float32(1.06 + rng.uniform(-0.04, 0.04))
        rows, cols = image.shape[:2]
        r, c = int(rng.integers(257)), int(rng.integers(263))
        image += 1.9 * self._bank[r : r + rows, c : c + cols]
        return np.asarray(np.clip(image, 0, 255).astype(np.uint8))

    def encode(self, image: Bytes, quality: int) -> bytes:
        """A baseline JPEG with halved chroma."""
        import simplejpeg

        return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", "420"))
