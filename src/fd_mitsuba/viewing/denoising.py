"""Rendered images without their grain: Intel's Open Image Denoise, where its wheel is installed."""

from __future__ import annotations

import importlib.util

import numpy as np

NO_DENOISER = "no denoiser: photographs take more samples and keep some grain; pip install mitsuba-oidn for clean ones"


def has_denoiser() -> bool:
    """Whether `denoised` can work: the package `mitsuba-oidn` is installed."""
    return importlib.util.find_spec("mitsuba_oidn") is not None


def denoised(colour: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) float32, linear, without noise; never negative.

    Args:
        colour: (H, W, 3) linear radiance of independent pixels, so of a box filter. Values that are not finite count 0.
        albedo: (H, W, 3) in [0, 1], and
        normal: (H, W, 3) shading normals in [-1, 1], both of the same view and all but free of noise themselves: where
            they have an edge, the image may.

    Raises:
        ImportError: see `has_denoiser`.
    """
    import mitsuba_oidn

    images = [np.nan_to_num(image, posinf=0.0, neginf=0.0) for image in (colour, albedo, normal)]
    images = [np.ascontiguousarray(image, dtype=np.float32) for image in images]
    # The best quality takes four times as long for one decibel, which twice as many samples give sooner.
    quality = mitsuba_oidn.Quality.Fast
    return np.array(mitsuba_oidn.denoise(*images, hdr=True, clean_aux=True, quality=quality)).clip(min=0)
