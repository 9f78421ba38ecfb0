"""The prior's training starts, resumes, and starts from packed weights."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
import torch

import fd_mitsuba.prior.training.train as train_module
from fd_mitsuba.cli.main import main
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.guidance.builtin import BUILTIN_FOLDER, builtin_folder
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews
from fd_mitsuba.prior.training.kinds import APPEARANCE, GEOMETRY, GEOMETRY_FINE, KINDS, kind_named
from fd_mitsuba.prior.training.model import build_scheduler, build_tokenizer, tokenize
from fd_mitsuba.prior.training.pack import pack
from fd_mitsuba.prior.training.pool import Pool, WorkerPool
from fd_mitsuba.prior.training.train import train
from fd_mitsuba.prior.training.training_folder import TrainingFolder


def test_training_resumes_and_starts_from_packed_weights(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train(first, seconds=600, batch_size=2, total_steps=1)
    train(first, seconds=600, batch_size=2, total_steps=2)
    state = torch.load(first / "checkpoint.pt", weights_only=True)
    assert state["step"] == 2
    pack(first / "checkpoint.pt", tmp_path / "packed")
    assert builtin_folder(tmp_path / "packed")
    for weights in (state["modules"], state["average"]):
        weights["unet.conv_in.weight"] = weights["unet.conv_in.weight"][:, 1:]
    torch.save(state, tmp_path / "checkpoint.pt")
    for use in (lambda: train(tmp_path, seconds=600), lambda: pack(tmp_path / "checkpoint.pt", tmp_path / "not")):
        with pytest.raises(UserError, match=r"checkpoint.pt: unet.conv_in.weight is of shape \(32, 8, 3, 3\), not"):
            use()
    assert not (tmp_path / "not").exists()
    state = torch.load(first / "checkpoint.pt", weights_only=True)

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
    assert '"sample_size": 32' in (tmp_path / "packed" / "unet" / "config.json").read_text()  # small steps alone
    assert sum(path.stat().st_size for path in (tmp_path / "packed").rglob("*")) < 10e6
    with pytest.raises(UserError, match="--kind appearance"):
        train(tmp_path / "run", seconds=600, batch_size=2, total_steps=2)


def test_the_finer_prior_goes_on_where_it_was_and_answers_with_larger_views(tmp_path: Path) -> None:
    run, packed = tmp_path / "run", tmp_path / "packed"
    train(run, seconds=600, kind=GEOMETRY_FINE, batch_size=2, total_steps=1, init=BUILTIN_FOLDER)
    train(run, seconds=600, kind=GEOMETRY_FINE, batch_size=2, total_steps=2, init=BUILTIN_FOLDER)
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 2
    pack(run / "checkpoint.pt", packed)
    assert sum(path.stat().st_size for path in packed.rglob("*")) < 25e6
    guidance = DiffusionGuidance.load(GuidanceConfig(model=str(packed), normalise_gradient=True))
    assert guidance.picture_size("coarse") == 64 and builtin_folder(packed)
    assert guidance.set_prompt("a dragon with bat wings") == []
    pictures = torch.rand(4, 5, 64, 64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    views = GuidanceViews(pictures, torch.rand(4, 5, 64, 64), [0.0, 90.0, 180.0, 270.0], [10.0] * 4, closeup=True)
    result = guidance.guide(views, 0, 10, "coarse", 0)
    result.loss.backward()
    assert pictures.grad is not None and pictures.grad.isfinite().all() and pictures.grad.abs().sum() > 0
    assert result.preview.shape == (1, 4, 128, 128)


def test_worker_processes_fill_the_pool() -> None:
    pool = WorkerPool(GEOMETRY, seed=5, workers=1)
    try:
        pool.refresh(20)
        base, edited, part, captions = pool.batch(4)
    finally:
        pool.close()
    assert base.shape == (4, 5, 64, 64) and edited.shape == (4, 4, 64, 64)
    assert part.shape == (4, 1, 64, 64) and all(captions)
    assert not any(process.is_alive() for process in pool._processes)


def test_a_device_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("cuda:63", "gpu"):
        assert main(["prior", "train", "--device", name, "-o", str(tmp_path / "run")]) != 0
        assert f"--device = '{name}'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


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


def test_a_kind_that_is_not_shipped_needs_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prior", "evaluate", "--kind", "geometry_fine"]) == 1
    assert "no such prior is shipped; name the folder of one" in capsys.readouterr().err


def test_kinds_are_named() -> None:
    assert {kind_named(name).name for name in KINDS} == {
        "geometry",
        "geometry_wide",
        "geometry_fine",
        "appearance",
        "appearance_fine",
    }
    with pytest.raises(UserError, match="known: geometry, geometry_wide, geometry_fine, appearance, appearance_fine"):
        kind_named("smell")


def test_a_signal_ends_the_training_with_what_it_has_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(folder: TrainingFolder, line: dict) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(train_module, "LOG_EVERY", 1)
    monkeypatch.setattr(TrainingFolder, "log", interrupted)
    with pytest.raises(Interrupted, match=r"SIGTERM: stopped after step 1 of 4; the same command goes on"):
        train(tmp_path / "run", seconds=600, batch_size=2, total_steps=4)
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["step"] == 1


def test_a_training_that_learns_nothing_any_more_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_module, "LOG_EVERY", 2)
    with pytest.raises(UserError, match="2 steps in a row had a loss that is not finite; start anew with a lower"):
        train(tmp_path / "run", seconds=600, batch_size=2, total_steps=9, rate=1e30)
