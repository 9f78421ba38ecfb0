"""Several views as one picture, for models that were trained to draw an object from all sides at once."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def tile_views(pictures: Float[Tensor, "B C H W"], grid: int) -> Float[Tensor, "M C gridH gridW"]:
    """Mosaics (B / grid^2, C, grid H, grid W) of consecutive pictures (B, C, H, W), row by row from the top left.

    Gradients flow. `grid` 1 returns the pictures as they are.
    """
    count, channels, height, width = pictures.shape
    if count % grid**2:
        raise ValueError(f"{count} views do not fill mosaics of {grid} x {grid}; give a multiple of {grid**2}")
    if grid == 1:
        return pictures
    rows = pictures.reshape(count // grid**2, grid, grid, channels, height, width)
    return rows.permute(0, 3, 1, 4, 2, 5).reshape(-1, channels, grid * height, grid * width)


def untile_views(mosaics: Float[Tensor, "M C gridH gridW"], grid: int) -> Float[Tensor, "B C H W"]:
    """The pictures of mosaics: undoes `tile_views`."""
    count, channels, height, width = mosaics.shape
    rows = mosaics.reshape(count, channels, grid, height // grid, grid, width // grid)
    return rows.permute(0, 2, 4, 1, 3, 5).reshape(-1, channels, height // grid, width // grid)
