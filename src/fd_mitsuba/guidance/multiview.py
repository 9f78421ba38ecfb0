"""Models that see several views of an object at once and are told their cameras: MVDream (arXiv 2308.16512).

The UNet is Stable Diffusion's, with two changes. The self-attention of each layer runs over the tokens of all views of
a group as one sequence, so that a view sees the others. And each view's camera goes through an MLP of its own and is
added to the embedding of the timestep, which Diffusers' UNet has as `class_embed_type = "projection"`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fd_mitsuba.guidance.interface import Angles

CAMERA_NUMBERS = 16
"""Of a camera: a 4 x 4 matrix, row by row."""
USUAL_GROUP = 4
"""Views that the published weights see at once."""
TEMPLATE = "{prompt}, {closeup}, 3d asset"
"""How the texts of the published weights' 3D data ended. The cameras say where each view stands, so words need not."""


def is_multiview(unet: dict[str, Any]) -> bool:
    """Whether a UNet's config, in Diffusers' terms, asks for a camera of each view."""
    given = unet.get("class_embed_type"), unet.get("projection_class_embeddings_input_dim")
    return given == ("projection", CAMERA_NUMBERS)


def camera_conditions(azimuth_deg: Angles, elevation_deg: Angles) -> Float[Tensor, "B 16"]:
    """Camera-to-world matrices as MVDream's weights know them, row by row.

        [ right  up  back  back ]      with  F (x, y, z) = (x, -z, y)  applied to each of the four columns
        [   0    0    0     1   ]

    The camera looks along -back, as in OpenGL and Blender; F leads from this package's frame, +y up and the front at
    +z, to Blender's, +z up and the front at -y. The last column is where the camera stands seen from what it looks at,
    at distance 1: these models were trained on objects in the middle of the picture and know no distances. So cameras
    that look beside the origin, and close-ups, have the matrix of one that looks at the whole object from there.

    Args:
        azimuth_deg: B, 0 in front of the object, 90 on +x; elevation_deg: B, towards +y. `scene.views.CameraBatch`.

    Example:
        >>> camera_conditions([0.0], [0.0]).view(4, 4)[:3, 3]
        tensor([ 0., -1.,  0.])
    """
    az, el = (np.radians(np.asarray(angles, dtype=np.float64)) for angles in (azimuth_deg, elevation_deg))
    zero = np.zeros_like(az)
    right = np.stack([np.cos(az), zero, -np.sin(az)], axis=1)
    up = np.stack([-np.sin(el) * np.sin(az), np.cos(el), -np.sin(el) * np.cos(az)], axis=1)
    back = np.stack([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)], axis=1)
    columns = np.stack([right, up, back, back], axis=2)
    matrix = np.zeros((len(az), 4, 4))
    matrix[:, 0], matrix[:, 1], matrix[:, 2] = columns[:, 0], -columns[:, 2], columns[:, 1]
    matrix[:, 3, 3] = 1
    return torch.from_numpy(matrix.reshape(-1, CAMERA_NUMBERS).astype(np.float32)) + 0.0  # no -0


class JointAttention:
    """An attention processor of Diffusers: self-attention over all tokens of `views` consecutive rows.

    Rows (N, tokens, width), N a multiple of `views`, are N / views sequences of views tokens each; groups never mix.
    """

    def __init__(self, views: int) -> None:
        from diffusers.models.attention_processor import AttnProcessor2_0

        self.views, self._plain = views, AttnProcessor2_0()

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
    ) -> Tensor:
        """What the attention layer `attn` makes of the rows, in their own shape."""
        assert encoder_hidden_states is None and attention_mask is None, "self-attention to all tokens"
        rows, tokens, width = hidden_states.shape
        if rows % self.views:
            raise ValueError(f"{rows} views do not fill groups of {self.views}")
        joined = hidden_states.reshape(rows // self.views, self.views * tokens, width)
        return self._plain(attn, joined).reshape(rows, tokens, width)


def join_views(unet: Any, views: int) -> None:
    """Let the UNet's self-attention see `views` consecutive rows at once; its attention to the text stays as it is."""
    kept = unet.attn_processors
    unet.set_attn_processor(
        {name: JointAttention(views) if ".attn1." in name else processor for name, processor in kept.items()}
    )
