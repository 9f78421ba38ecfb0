"""Shares of a batch on several threads give the gradient of the whole batch."""

from __future__ import annotations

import pytest
import torch

from fd_mitsuba.prior.training.replicas import Replicas

SIZE = 5


@pytest.mark.parametrize("count", [1, 2, 3])
def test_gradient_is_that_of_the_mean_over_the_batch(count: int) -> None:
    torch.manual_seed(0)
    layers = {"first": torch.nn.Linear(3, 4), "second": torch.nn.Linear(4, 1), "idle": torch.nn.Linear(2, 2)}
    modules = torch.nn.ModuleDict(layers).double()
    inputs, targets = torch.randn(SIZE, 3, dtype=torch.double), torch.randn(SIZE, 1, dtype=torch.double)

    def share(of: torch.nn.ModuleDict, samples: slice) -> tuple[torch.Tensor, torch.Tensor]:
        error = (of["second"](of["first"](inputs[samples]).tanh()) - targets[samples]).square()
        return error.mean(), error.detach()

    replicas = Replicas(modules, count)
    optimiser = torch.optim.AdamW(modules.parameters(), lr=0.1)
    for _ in range(3):
        share(modules, slice(0, SIZE))[0].backward()
        expected = [None if p.grad is None else p.grad.clone() for p in modules.parameters()]
        errors = share(modules, slice(0, SIZE))[1]
        modules.zero_grad(set_to_none=True)
        found = replicas.backward(share, SIZE)
        assert len(found) == count
        # Products of matrices of other heights may be rounded otherwise, as the processor's BLAS likes.
        torch.testing.assert_close(torch.cat(found), errors, rtol=1e-12, atol=1e-14)
        for parameter, gradient in zip(modules.parameters(), expected, strict=True):
            assert (parameter.grad is None) == (gradient is None)
            if gradient is not None:
                torch.testing.assert_close(parameter.grad, gradient, rtol=1e-12, atol=1e-14)
        optimiser.step()  # the weights change for all of them
        optimiser.zero_grad(set_to_none=True)


def test_an_error_of_one_thread_reaches_the_caller() -> None:
    def share(of: torch.nn.ModuleDict, samples: slice) -> tuple[torch.Tensor, None]:
        raise RuntimeError(f"no {samples.start}")

    with pytest.raises(RuntimeError, match="no 0"):
        Replicas(torch.nn.ModuleDict({"a": torch.nn.Linear(1, 1)}), 2).backward(share, 2)
