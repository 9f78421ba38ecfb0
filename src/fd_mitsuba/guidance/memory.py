"""Whether a pipeline fits: bytes of weights and working set against what the machine can still give."""

from __future__ import annotations

import os
import resource
from pathlib import Path
from typing import Any

import torch

from fd_mitsuba.backend.startup import renders_on_card
from fd_mitsuba.errors import UserError

BYTES = {"float32": 4, "bfloat16": 2, "float16": 2}

VAE_TENSORS = 7
"""Feature maps per resnet block that an encoder's backward pass keeps: 3.3 GB for a 512 x 512 picture and SD 1.5."""
UNET_TENSORS = 50
"""Feature maps at the first width that a forward pass holds: 0.26 GB for a picture at 64 x 64 and SD 1.5's UNet."""

CRITIC_TENSORS = {"float32": 305, "bfloat16": 396, "float16": 396}
"""Feature maps at the first width, in that dtype, that the critic of `vsd` keeps for its way back: 1.6 GB a picture at
64 x 64 and SD 1.5's UNet in float32, 1.04 in bfloat16. Counted by what autograd saves there."""
CRITIC_VALUES = 630
"""Values of its matrices for each rank, over the UNet's first width; each has a gradient and two moments."""


RENDERER_ON_CARD = 1_000_000_000
"""What a renderer on the same card is left. Not measured on one: the arrays of four views of 512 pixels with 8 samples
take 0.5 GB on the CPU, where a sample takes 59 bytes, and OptiX keeps the scene besides."""


def available_bytes(device: str = "cpu") -> int | None:
    """Bytes that can still be allocated on a device; for the CPU what is free or reclaimable within the cgroup's limit.

    None where the system does not say.
    """
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(torch.device(device))[0]
    amounts = [_meminfo_available() or _sysconf_available(), _cgroup_available(), _limit_available()]
    known = [amount for amount in amounts if amount is not None]
    return min(known) if known else None


def held_bytes() -> int:
    """Bytes of memory that this process has now; 0 where the system does not say."""
    return _own_pages(1)


def _own_pages(which: int) -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[which]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0


def _limit_available() -> int | None:
    """What `ulimit -v` leaves."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else max(limit - _own_pages(0), 0)


def _meminfo_available() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        pass
    return None


def _sysconf_available() -> int | None:
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def _cgroup_available(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int | None:
    """What the tightest of the process's control groups leaves: its own, or any that this is nested in."""
    group = _own_group(own)
    levels = [root / path for path in (group, *group.parents)]
    known = [amount for level in levels if (amount := _left_in_group(level)) is not None]
    return min(known) if known else None


def _own_group(own: Path) -> Path:
    """The process's group below the root of version 2; the root itself where the system does not say."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return Path()
    paths = [line.removeprefix("0::") for line in lines if line.startswith("0::")]
    parts = [part for part in paths[0].split("/") if part not in ("", "..")] if paths else []
    return Path(*parts)


def _left_in_group(group: Path) -> int | None:
    try:
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        # The page cache counts as used but is given up under pressure.
        statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return limit - used + int(statistics.get("inactive_file", 0))
    except (OSError, ValueError):
        return None


def working_set_bytes(
    unet: dict[str, Any], vae: dict[str, Any], latent_size: int, batch: int, dtype: str, together: int = 1
) -> int:
    """Rough bytes beside the weights: one UNet forward pass of `batch` pictures, and the VAE encoder's backward pass.

    Args:
        unet, vae: the components' own configs.
        latent_size: side of the latents.
        batch: pictures in one call of the UNet. The encoder sees half of them, since guidance takes two passes or more.
        dtype: of the UNet; the VAE is float32.
        together: pictures that are never parted, for the encoder neither.
    """
    widths = unet.get("block_out_channels", (320,))
    unet_bytes = UNET_TENSORS * widths[0] * latent_size**2 * BYTES[dtype]
    # AutoencoderTiny names its encoder's widths and blocks one by one, AutoencoderKL has one count for all.
    widths = vae.get("encoder_block_out_channels") or vae.get("block_out_channels", (128,))
    blocks = vae.get("num_encoder_blocks") or [vae.get("layers_per_block", 2)] * len(widths)
    side = latent_size * 2 ** (len(widths) - 1)
    vae_bytes = sum(
        VAE_TENSORS * count * width * (side // 2**level) ** 2 * 4
        for level, (width, count) in enumerate(zip(widths, blocks, strict=False))
    )
    return batch * unet_bytes + max(together, batch // 2) * vae_bytes


def critic_bytes(unet: dict[str, Any], latent_size: int, pictures: int, dtype: str, rank: int) -> int:
    """What a critic of `vsd` takes besides: its lesson on so many pictures at once, and its matrices.

    Args:
        unet: the component's own config.
        rank: of the matrices; 0: there is no critic.
    """
    if not rank:
        return 0
    width = unet.get("block_out_channels", (320,))[0]
    lesson = CRITIC_TENSORS[dtype] * width * latent_size**2 * BYTES[dtype]
    return pictures * lesson + 4 * 4 * CRITIC_VALUES * width * rank


def require_memory(needed_weights: int, working_set: int, device: str, source: str) -> None:
    """Refuse, before anything is loaded, a pipeline that will not fit.

    A renderer on the same card takes a part of it, too.

    Raises:
        UserError: naming both numbers and what to change.
    """
    available = available_bytes(device)
    if torch.device(device).type == "cuda" and renders_on_card():
        working_set += RENDERER_ON_CARD
    needed = needed_weights + working_set
    if available is not None and needed > available:
        raise UserError(
            f"{source}: needs about {_gigabytes(needed)} ({_gigabytes(needed_weights)} of weights, "
            f"{_gigabytes(working_set)} to work in) but {device} has {_gigabytes(available)} left; lower "
            "guidance.views_per_call, which --resume accepts too, or start anew with guidance.dtype=bfloat16 or a "
            "smaller model such as builtin"
        )


def _gigabytes(count: int) -> str:
    return f"{count / 1e9:.2f} GB"
