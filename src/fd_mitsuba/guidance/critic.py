"""What variational score distillation compares the model with: the same UNet, taught what the pictures are like now.

A low-rank change (LoRA) of the attention's matrices, W + up down, that learns after each step to see the noise in the
step's own latents. It acts only where it is asked to; the UNet and its weights stay as they are.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor, nn

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.errors import RunStopped, UserError

_PLACES = ("to_q", "to_k", "to_v", "to_out.0")


class Critic:
    """The change of one UNet, and its optimiser. One that was just made, or `reset`, changes nothing.

    Args:
        unet: a Diffusers UNet.
        rank: of the change of each matrix.
        learning_rate: of AdamW without weight decay.

    Raises:
        UserError: the UNet has no attention.
    """

    def __init__(self, unet: nn.Module, rank: int, learning_rate: float) -> None:
        self._unet, self._rank, self._learning_rate = unet, rank, learning_rate
        self._layers: dict[str, nn.Linear] = {
            name: layer
            for name, layer in unet.named_modules()
            if isinstance(layer, nn.Linear) and any(name.endswith(f".{place}") for place in _PLACES)
        }
        if not self._layers:
            raise UserError("guidance.variant = vsd: the model's UNet has no attention to learn with; take another one")
        self._acts = False
        self.reset()
        for name, layer in self._layers.items():
            layer.register_forward_hook(partial(self._changed, name))

    def reset(self) -> None:
        """Forget everything: down is random, the same each time, and up is zero."""
        generator = torch.Generator().manual_seed(0)
        self._matrices: dict[str, Tensor] = {}
        for name, layer in self._layers.items():
            down = torch.randn(self._rank, layer.in_features, generator=generator) / self._rank
            self._matrices[f"{name}.down"] = down.to(layer.weight.device).requires_grad_()
            up = torch.zeros(layer.out_features, self._rank, device=layer.weight.device)
            self._matrices[f"{name}.up"] = up.requires_grad_()
        self._optimiser = torch.optim.AdamW(self._matrices.values(), lr=self._learning_rate, weight_decay=0)

    @contextlib.contextmanager
    def acting(self) -> Iterator[None]:
        """Within it the UNet is the critic."""
        self._acts = True
        try:
            yield
        finally:
            self._acts = False

    def take_step(self) -> None:
        """Change the matrices once along the gradients that `backward` has left, of all processes together.

        Raises:
            RunStopped: a gradient is not finite.
        """
        for matrix in self._matrices.values():
            assert matrix.grad is not None
            whole = matrix.grad.cpu()  # where the processes add up
            processes().add_up([whole])
            if not whole.isfinite().all():
                raise RunStopped(
                    "guidance.variant = vsd: the critic's gradient is not finite; set guidance.dtype to float32"
                )
            matrix.grad = whole.to(matrix.device)
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Tensor]:
        """Matrices and moments, for a checkpoint; on the CPU."""
        found = {f"matrix.{name}": matrix.detach() for name, matrix in self._matrices.items()}
        for index, moments in self._optimiser.state_dict()["state"].items():
            found |= {f"moment.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        return {name: value.cpu().contiguous() for name, value in found.items()}

    @torch.no_grad()
    def load_state(self, state: dict[str, Tensor]) -> None:
        """Go on from a `state`.

        Raises:
            ValueError: of another model or rank.
        """
        stored = {name[7:]: value for name, value in state.items() if name.startswith("matrix.")}
        if {n: v.shape for n, v in stored.items()} != {n: v.shape for n, v in self._matrices.items()}:
            raise ValueError("the critic's matrices are those of another model")
        self.reset()
        for name, matrix in self._matrices.items():
            matrix.copy_(stored[name])
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in state.items():
            if name.startswith("moment."):
                _, index, key = name.split(".", 2)
                moments.setdefault(int(index), {})[key] = value
        self._optimiser.load_state_dict(self._optimiser.state_dict() | {"state": moments})

    def _changed(self, name: str, _: nn.Module, given: tuple[Tensor], output: Tensor) -> Tensor | None:
        if not self._acts:
            return None
        down, up = self._matrices[f"{name}.down"], self._matrices[f"{name}.up"]
        change = nn.functional.linear(nn.functional.linear(given[0].float(), down), up)
        return output + change.to(output.dtype)
