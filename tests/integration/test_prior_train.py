"""The prior's training starts, resumes, and starts from packed weights."""

from __future__ import annotations

from pathlib import Path

import torch

from fd_mitsuba.guidance.builtin import builtin_folder
from fd_mitsuba.prior.pack import pack
from fd_mitsuba.prior.train import train


def test_training_resumes_and_starts_from_packed_weights(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train(first, seconds=600, batch_size=2, total_steps=1)
    train(first, seconds=600, batch_size=2, total_steps=2)
    state = torch.load(first / "checkpoint.pt", weights_only=True)
    assert state["step"] == 2
    pack(first / "checkpoint.pt", tmp_path / "packed")
    assert builtin_folder(tmp_path / "packed")

    train(second, seconds=0, batch_size=2, total_steps=1, init=tmp_path / "packed")
    started = torch.load(second / "checkpoint.pt", weights_only=True)
    assert started["step"] == 0
    for key, value in started["modules"].items():
        if value.is_floating_point():
            assert torch.equal(value, state["average"][key].half().float()), key
    name = Path("tokenizer") / "tokenizer.json"
    assert (second / name).read_bytes() == (first / name).read_bytes()
