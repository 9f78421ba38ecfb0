"""Some pictures of a step as the network is given them, without gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Beside:
    """What the network sees beside the noisy latents, in all passes but where it is said.

    Attributes:
        condition: the base's latents (n, 4, L, L) for 8 input channels; the pass `plain` sees zeros in their place.
            For 9 channels (n, 5, L, L), the mask first; all passes see an inpainting model's. The base's latents alone
            are taken for a mask of zeros by a network that is told where the part may be.
        control: pictures (n, 3, H, H) in [0, 1] for the ControlNet; None: it is not asked.
        cameras: (n, 16), of `camera_conditions`, for a network that sees several views at once; its groups are
            consecutive and whole.
    """

    condition: Tensor | None = None
    control: Tensor | None = None
    cameras: Tensor | None = None

    def told(self, region: Tensor) -> Beside:
        """The same with another mask (n, 1, L, L)."""
        assert self.condition is not None
        return replace(self, condition=torch.cat([region, self.condition[:, -4:]], dim=1))

    def rows(self, rows: slice) -> Beside:
        """The same of some of the pictures."""
        return Beside(some(self.condition, rows), some(self.control, rows), some(self.cameras, rows))


def some(whole: Tensor | None, rows: slice) -> Tensor | None:
    """Some rows of what may not be there."""
    return None if whole is None else whole[rows]


NOTHING = Beside()


@dataclass(frozen=True)
class Area:
    """A place in the pictures with texts of its own.

    Attributes:
        mask: (n, 1, L, L) in [0, 1]; of all areas together at most 1.
        texts: pass -> (n, length, width), of the passes whose text differs from the chunk's.
    """

    mask: Tensor
    texts: dict[str, Tensor]

    def rows(self, rows: slice) -> Area:
        """The area in some of the pictures."""
        return Area(self.mask[rows], {name: text[rows] for name, text in self.texts.items()})


@dataclass(frozen=True)
class Chunk:
    """What the network needs for some pictures: all (n, ...), on its device, without gradients.

    `mask` (n, 1, L, L) of zeros and ones confines noise and gradient; None: they are everywhere. `areas` have texts of
    their own: there the network's noise is what it sees with these.
    """

    z: Tensor
    noise: Tensor
    timesteps: Tensor
    texts: dict[str, Tensor]
    beside: Beside = NOTHING
    mask: Tensor | None = None
    areas: tuple[Area, ...] = ()
