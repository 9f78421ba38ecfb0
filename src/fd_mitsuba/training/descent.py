"""What every stage does with its losses: add them up, go one step down, and stop where the numbers break."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.backend.processes import Processes, processes
from fd_mitsuba.config.sections import AppearanceConfig, GeometryConfig
from fd_mitsuba.errors import RunStopped


def adamw(field: torch.nn.Module, settings: GeometryConfig | AppearanceConfig) -> torch.optim.AdamW:
    """The optimiser of a stage's field."""
    return torch.optim.AdamW(
        field.parameters(),
        lr=settings.learning_rate,
        betas=settings.betas,
        eps=settings.eps,
        weight_decay=settings.weight_decay,
        fused=True,
    )


def fade(optimiser: torch.optim.Optimizer, settings: GeometryConfig | AppearanceConfig, step: int) -> None:
    """Set the step size of step `step`, counted from 0: half a cosine down to zero over the last `settings.fade`.

    What single steps shake, the noise of views, timesteps and latents, leaves the field as the steps become small. It
    follows from the step alone, so that a resumed run goes on with the same ones.
    """
    left = max(1 - step / settings.steps, 0.0)
    share = 1.0 if left >= settings.fade else 0.5 - 0.5 * math.cos(math.pi * left / settings.fade)
    for group in optimiser.param_groups:
        group["lr"] = settings.learning_rate * share


def descend(
    optimiser: torch.optim.Optimizer,
    losses: Mapping[str, Tensor],
    weights: Mapping[str, float],
    step: int,
    remedy: str,
) -> dict[str, float]:
    """Change the parameters once along the weighted sum of `losses`; returns every `loss_<name>`, and `loss`.

    Nothing is changed where no loss depends on the parameters.

    Raises:
        RunStopped: a loss or a gradient is not finite; the message ends with `remedy`.
    """
    group = processes()
    total = sum(weights[name] * loss for name, loss in losses.items())
    values = {f"loss_{name}": float(loss.detach()) for name, loss in losses.items()}
    values["loss"] = float(total.detach()) if isinstance(total, Tensor) else 0.0
    if group.count > 1:
        # The guidance's loss is of the process's own views, all others are the same in every process.
        total = sum(weights[name] * loss / (1 if name == "sds" else group.count) for name, loss in losses.items())
        values = group.values_of_all(values)
        values["loss"] = sum(weights[name] * values[f"loss_{name}"] for name in losses)
    if not np.isfinite(values["loss"]):
        raise RunStopped(f"step {step}: the loss is not finite; {remedy}")
    if isinstance(total, Tensor) and total.requires_grad:
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        parameters = [parameter for part in optimiser.param_groups for parameter in part["params"]]
        _add_up_gradients(group, parameters)
        for parameter in parameters:
            if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
                raise RunStopped(f"step {step}: a gradient is not finite; {remedy}")
        optimiser.step()
    return values


def _add_up_gradients(group: Processes, parameters: list[Tensor]) -> None:
    if group.count == 1:
        return
    for parameter in parameters:
        if parameter.grad is None:  # another process's views may have one
            parameter.grad = torch.zeros_like(parameter)
    group.add_up(parameter.grad for parameter in parameters if parameter.grad is not None)
