"""What a bend of the shading normal costs: a normal map is for detail, not for turning a whole part to the light."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def loss_bend(normal: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Mean over points of `|slope|^2 = tan(angle to the mesh's normal)^2`.

    Not in the paper. Under one light, normals that all lean towards it make a part as bright as the guidance likes;
    under another the part is then lit from where no light is. Detail is worth this price, such a lean is not.

    Args:
        normal: (N, 3) unit, tangent space, third coordinate positive, as `fields.texture` gives it.

    Gradients flow to it. No points: 0.
    """
    squared = normal[:, :2].square().sum(dim=1) / normal[:, 2].square()
    return squared.mean() if len(squared) else squared.sum()
