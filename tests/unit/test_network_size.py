"""How large a network is, told from its files' heads."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.runs.network_size import NetworkSize, network_size


def folder_with(path: Path, shards: list[dict[str, torch.Tensor]], **config: object) -> str:
    unet = path / "unet"
    unet.mkdir(parents=True)
    (unet / "config.json").write_text(json.dumps(config))
    stem, names = "diffusion_pytorch_model", {}
    for number, tensors in enumerate(shards):
        name = f"{stem}.safetensors" if len(shards) == 1 else f"{stem}-{number}.safetensors"
        save_file(tensors, unet / name)
        names |= dict.fromkeys(tensors, name)
    if len(shards) > 1:
        (unet / f"{stem}.safetensors.index.json").write_text(json.dumps({"weight_map": names}))
    return str(path)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_weights_are_counted_in_any_precision_whatever_the_file_is_called(tmp_path: Path, dtype: torch.dtype) -> None:
    tensors = {"a": torch.zeros(100, 30, dtype=dtype), "b": torch.zeros(5, dtype=torch.float32)}
    found = network_size(folder_with(tmp_path / "model", [tensors], sample_size=96, in_channels=8))
    assert (found.weights, found.latent_size, found.has_image_pass) == (3005, 96, True)
    assert str(tmp_path / "model" / "unet") in found.source


def test_a_folder_may_be_at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    folder_with(tmp_path / "model", [{"a": torch.zeros(700)}])
    (tmp_path / "model" / "fd_mitsuba.json").write_text('{"vocabulary": {"bodies": {}, "parts": {"wings": ["wings"]}}}')
    vocabulary = vocabulary_of("~/model")
    assert network_size("~/model").weights == 700 and vocabulary is not None and "wings" in vocabulary.parts


def test_shards_are_added_up(tmp_path: Path) -> None:
    shards = [{"a": torch.zeros(700)}, {"b": torch.zeros(20, dtype=torch.float16)}, {"c": torch.zeros(3, 3)}]
    assert network_size(folder_with(tmp_path / "model", shards)).weights == 729


def test_an_original_layout_names_its_side_otherwise(tmp_path: Path) -> None:
    path = folder_with(tmp_path / "model", [{"a": torch.zeros(4)}], image_size=32, in_channels=4)
    assert network_size(path).latent_size == 32


def test_what_cannot_be_read_counts_as_stable_diffusion(tmp_path: Path) -> None:
    assert network_size("somebody/model") == NetworkSize() and not NetworkSize().has_image_pass
    path = Path(folder_with(tmp_path / "model", [{"a": torch.zeros(4)}], sample_size=32))
    (path / "unet" / "diffusion_pytorch_model.safetensors").write_bytes(b"cut short")
    found = network_size(str(path))
    assert (found.weights, found.latent_size) == (860e6, 32)


def test_the_shipped_priors_are_known() -> None:
    shapes, colours = network_size("builtin"), network_size("builtin", appearance=True)
    assert shapes.has_image_pass and shapes.weights != colours.weights and shapes.source == "the built-in prior"
