"""The prior's training starts, resumes, and starts from packed weights."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
import torch

import fd_mitsuba.prior.training.train as train_module
from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.guidance.builtin import builtin_folder
from fd_mitsuba.prior.training.kinds import APPEARANCE, KINDS, kind_named
from fd_mitsuba.prior.training.model import build_scheduler, build_tokenizer, tokenize
from fd_mitsuba.prior.training.pack import pack
from fd_mitsuba.prior.training.train import Pool, train
from fd_mitsuba.prior.training.training_folder import TrainingFolder


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
    assert started["vocabulary"] == state["vocabulary"]


def test_the_appearance_prior_trains_with_its_own_pictures(tmp_path: Path) -> None:
    train(tmp_path / "run", seconds=600, kind=APPEARANCE, batch_size=2, total_steps=1)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert (state["step"], state["kind"]) == (1, "appearance")
    pack(tmp_path / "run" / "checkpoint.pt", tmp_path / "packed")
    text = (builtin_folder(tmp_path / "packed") / "fd_mitsuba.json").read_text()
    assert '"condition": "clay"' in text and "normal_space" not in text
    assert sum(path.stat().st_size for path in (tmp_path / "packed").rglob("*")) < 10e6
    with pytest.raises(UserError, match="--kind appearance"):
        train(tmp_path / "run", seconds=600, batch_size=2, total_steps=2)


@pytest.mark.slow
def test_random_weights_learn_colour_words(tmp_path: Path) -> None:
    train(tmp_path, seconds=3600, kind=APPEARANCE, total_steps=600)
    tokenizer = build_tokenizer()
    modules = APPEARANCE.build_modules(tokenizer)
    modules.load_state_dict(torch.load(tmp_path / "checkpoint.pt", weights_only=True)["modules"])
    pool = Pool(APPEARANCE, seed=12345)
    pool.refresh(64)
    base, edited, part, captions = pool.batch(32)
    times = torch.full((32,), 900)
    alpha_bar = build_scheduler(APPEARANCE.prediction).alphas_cumprod[900]
    noise = torch.randn(edited.shape, generator=torch.Generator().manual_seed(5)) * part
    seen = torch.cat([alpha_bar.sqrt() * edited + (1 - alpha_bar).sqrt() * noise, base], dim=1)

    def error(captions: list[str]) -> float:
        with torch.no_grad():
            words = modules["text_encoder"](tokenize(tokenizer, captions)).last_hidden_state
            said = modules["unet"](seen, times, words).sample
        return (((said - edited).square() * part).sum() / part.sum()).item()

    assert error(captions) < 0.75 * error(captions[1:] + captions[:1])


def test_kinds_are_named() -> None:
    assert {kind_named(name).name for name in KINDS} == {"geometry", "appearance"}
    with pytest.raises(UserError, match="known: geometry, appearance"):
        kind_named("smell")


def test_a_signal_ends_the_training_with_what_it_has_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(folder: TrainingFolder, line: dict) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(train_module, "LOG_EVERY", 1)
    monkeypatch.setattr(TrainingFolder, "log", interrupted)
    with pytest.raises(Interrupted, match=r"SIGTERM: stopped after step 1 of 4; the same command goes on"):
        train(tmp_path / "run", seconds=600, batch_size=2, total_steps=4)
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["step"] == 1
