"""The only crossing between torch and Dr.Jit: whole tensors, once per pass.

Torch hosts the fields and the guidance; Dr.Jit differentiates what Mitsuba traced. `differentiable` runs a Dr.Jit
function on copies of torch tensors and appears to torch as one differentiable operation. Fields and pictures are on the
CPU, wherever Mitsuba renders: with a CUDA variant the copies cross over to the card and back.
"""

from __future__ import annotations

import atexit
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from fd_mitsuba.backend.upload import upload_floats

_LOCK = threading.RLock()  # Dr.Jit's AD graph and the mesh inside a scene are shared by all threads

DrJitFunction = Callable[..., "mi.Float"]


def to_drjit(tensor: torch.Tensor) -> mi.Float:
    """A flat Dr.Jit copy, detached. A copy, because Dr.Jit would otherwise see torch's later in-place changes."""
    return upload_floats(tensor.detach().to("cpu", torch.float32).numpy())


def to_torch(array: mi.Float) -> torch.Tensor:
    """A flat float32 copy of evaluated values, on the CPU."""
    return array.torch().to("cpu", copy=True)


def indices_to_torch(array: mi.UInt32) -> torch.Tensor:
    """A flat int64 copy of evaluated whole numbers below 2^31, on the CPU."""
    return mi.Int32(array).torch().to("cpu", torch.int64, copy=True)


def differentiable(function: DrJitFunction, *tensors: torch.Tensor) -> torch.Tensor:
    """`function` of torch tensors: flat float32, with gradients to every tensor that requires them.

    Args:
        function: takes one flat `mi.Float` for each tensor and returns one flat `mi.Float`. What it traces must be
            evaluated when it returns: the scene may have moved on before torch calls for the derivative.
        tensors: float tensors of any shape; gradients come back in their shape and dtype.

    Backward may run again with `retain_graph=True`; second derivatives raise, as they do for any
    `once_differentiable` function. Not a way to run two passes at once: a lock makes threads take turns.
    """
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return _Crossing.apply(function, *tensors)
    with _LOCK, dr.suspend_grad():
        return to_torch(function(*(to_drjit(tensor) for tensor in tensors)))


@dataclass(eq=False)
class _Traced:
    """What a backward pass will need of Dr.Jit."""

    inputs: list[mi.Float]
    output: mi.Float | None


_LIVE: weakref.WeakSet[_Traced] = weakref.WeakSet()


@atexit.register
def _release() -> None:
    """A torch graph that outlives Dr.Jit, as one held by a global name does, would crash the process as it ends."""
    for traced in list(_LIVE):
        traced.inputs, traced.output = [], None


class _Crossing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, function: DrJitFunction, *tensors: torch.Tensor) -> torch.Tensor:
        with _LOCK:
            inputs = [to_drjit(tensor) for tensor in tensors]
            for array, tensor in zip(inputs, tensors, strict=True):
                if tensor.requires_grad:
                    dr.enable_grad(array)
            output = function(*inputs)
            dr.eval(output)
            ctx.traced = _Traced(inputs, output)
            _LIVE.add(ctx.traced)
            ctx.like = [(tensor.shape, tensor.dtype) for tensor in tensors]
            return to_torch(dr.detach(output))

    # What `once_differentiable` makes of it takes no keywords, which torch's own signature has.
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, gradient: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        with _LOCK:
            inputs, output = ctx.traced.inputs, ctx.traced.output
            wanted = [array for array in inputs if dr.grad_enabled(array)]
            dr.clear_grad(wanted)
            if dr.grad_enabled(output):  # false where nothing was seen
                dr.set_grad(output, to_drjit(gradient))
                dr.enqueue(dr.ADMode.Backward, output)
                # Edges stay for a second backward; they are freed with this node when torch drops its graph.
                dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
            results: list[torch.Tensor | None] = []
            for array, (shape, dtype) in zip(inputs, ctx.like, strict=True):
                if dr.grad_enabled(array):
                    results.append(to_torch(dr.grad(array)).reshape(shape).to(dtype))
                else:
                    results.append(None)
            return None, *results
