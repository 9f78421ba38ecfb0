"""How large the network of a guidance model is, told from its files' heads before anything is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.builtin import shipped_folder
from fd_mitsuba.guidance.layout import count_weights, read_json, weight_files
from fd_mitsuba.guidance.model_conventions import read_model_conventions


@dataclass(frozen=True)
class NetworkSize:
    """Of a UNet; that of Stable Diffusion 1.5 where no local folder says another.

    Attributes:
        weights: how many.
        source: how that is known.
        latent_size: cells a side of the latents that it was made for.
        channels: of its input.
        sees_region: whether one of them tells where the part may be.
    """

    weights: float = 860e6
    source: str = "as Stable Diffusion 1.5; the model is not in a local folder"
    latent_size: int = 64
    channels: int = 4
    sees_region: bool = False

    @property
    def has_image_pass(self) -> bool:
        """As `Denoiser.has_image_pass`."""
        return self.channels == 8 or self.sees_region


def network_size(model: str, appearance: bool = False) -> NetworkSize:
    """The UNet of a value of `guidance.model`.

    Args:
        appearance: `builtin` means the prior of colours.
    """
    shipped = shipped_folder(model, appearance)
    folder = Path(model).expanduser() if shipped is None else shipped
    usual = NetworkSize()
    try:
        config = read_json(folder / "unet" / "config.json")
        sees_region = read_model_conventions(folder).sees_region
    except UserError:
        config, sees_region = {}, False
    size, channels = (_number(config, *keys) for keys in (("sample_size", "image_size"), ("in_channels",)))
    try:
        weights: float = sum(map(count_weights, weight_files(folder, "unet")[0]))
        source = "the built-in prior" if shipped else f"from {folder / 'unet'}"
    except (UserError, OSError):  # none, or a damaged file, which the run will refuse
        weights, source = usual.weights, usual.source
    return NetworkSize(weights, source, size or usual.latent_size, channels or usual.channels, sees_region)


def _number(config: dict[str, Any], *keys: str) -> int | None:
    for key in keys:
        value = config.get(key)
        value = value[0] if isinstance(value, list) and value else value
        if isinstance(value, int) and value > 0:
            return value
    return None
