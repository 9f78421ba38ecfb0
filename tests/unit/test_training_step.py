"""One step of a prior's training: a batch that cannot be learned from changes nothing."""

from __future__ import annotations

from dataclasses import replace

import torch

from fd_mitsuba.prior.training.kinds import GEOMETRY
from fd_mitsuba.prior.training.model import TokenRows, build_scheduler, build_tokenizer, tokenize
from fd_mitsuba.prior.training.step import TrainingStep

SMALL = replace(GEOMETRY, channels=(4, 4, 8, 8), text_width=8, text_layers=1)


def test_a_gradient_that_is_not_finite_leaves_the_weights_alone() -> None:
    torch.manual_seed(0)
    tokenizer = build_tokenizer()
    modules = SMALL.build_modules(tokenizer)
    optimiser = torch.optim.AdamW(modules.parameters(), lr=1e-3, fused=True)
    step = TrainingStep(modules, optimiser, SMALL, build_scheduler(SMALL.prediction), False, 0)
    seen = torch.rand(2, 5, 64, 64) * 2 - 1
    base = seen[:, 1:]
    others = (base[:, :1] > 0).float(), torch.ones(2, 1, 1, 1), tokenize(tokenizer, ["a cat", "a cat with a crown"])

    def weights() -> torch.Tensor:
        return torch.cat([parameter.detach().ravel().clone() for parameter in modules.parameters()])

    assert step(seen, base, *others).isfinite().all()
    before = weights()
    assert not step(seen, base * torch.nan, *others).isfinite().any()
    assert torch.equal(weights(), before)
    assert step(seen, base, *others).isfinite().all()
    assert weights().isfinite().all() and not torch.equal(weights(), before)


def test_rows_of_tokens_are_those_of_the_tokenizer() -> None:
    tokenizer = build_tokenizer()
    rows, texts = TokenRows(tokenizer), ["a cat", "a horse with wings", "", "a cat"]
    for _ in range(2):
        assert torch.equal(rows(texts), tokenize(tokenizer, texts))
