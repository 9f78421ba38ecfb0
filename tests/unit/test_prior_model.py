from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.builtin import builtin_folder
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews
from fd_mitsuba.guidance.prompts import unknown_words, view_prompt
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.captions import PART_WORDS, caption, view_words, vocabulary
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.judging.evaluate import evaluate
from fd_mitsuba.prior.training.model import TEXT_LENGTH, build_text_encoder, build_tokenizer, build_unet
from fd_mitsuba.prior.training.pack import pack


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pipeline folder made from a checkpoint with random weights."""
    folder = tmp_path_factory.mktemp("prior")
    tokenizer = build_tokenizer()
    modules = torch.nn.ModuleDict({"text_encoder": build_text_encoder(tokenizer), "unet": build_unet(input_channels=9)})
    average = {key: value for key, value in modules.state_dict().items() if value.is_floating_point()}
    torch.save({"average": average}, folder / "checkpoint.pt")
    pack(folder / "checkpoint.pt", folder / "weights")
    return folder / "weights"


def test_every_word_of_the_vocabulary_is_one_token() -> None:
    tokenizer = build_tokenizer()
    for word in vocabulary():
        assert len(tokenizer.tokenize(word)) == 1, word
        assert len(tokenizer.tokenize(word.upper())) == 1
    assert len(tokenizer.tokenize("jetpack")) > 1


def test_tokens_are_numbered_alike_in_every_process() -> None:
    """Weights fit one numbering only, so training, resume and packing must agree on it."""
    code = "from fd_mitsuba.prior.training.model import build_tokenizer as b; print(sorted(b().get_vocab().items()))"
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    elsewhere = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True).stdout
    assert elsewhere.strip() == str(sorted(build_tokenizer().get_vocab().items()))


def test_captions_stay_within_the_vocabulary_and_the_text_length() -> None:
    tokenizer, random, known = build_tokenizer(), np.random.default_rng(0), set(vocabulary())
    for body in BODIES:
        for part in (None, *PARTS):
            for _ in range(6):
                text = f"{caption(body, part, random)}, {view_words(random.uniform(0, 360), True)}"
                assert set(re.findall(r"[^\s,]+", text)) <= known, text
                assert len(tokenizer(text).input_ids) <= TEXT_LENGTH
                assert part is None or not text.startswith(caption(body, None, np.random.default_rng(0)) + ",")


def test_every_part_has_its_words_and_no_two_share_a_phrase() -> None:
    assert set(PART_WORDS) == set(PARTS)
    phrases = [phrase for words in PART_WORDS.values() for phrase in words]
    assert len(phrases) == len(set(phrases))


def test_unknown_words_are_found() -> None:
    tokenizer = build_tokenizer()
    assert unknown_words(tokenizer, "A highly detailed horse with two wings") == []
    assert unknown_words(tokenizer, "a horse with a Jetpack, wearing sunglasses") == ["jetpack", "sunglasses"]


def test_a_packed_checkpoint_guides(packed: Path) -> None:
    config = GuidanceConfig(model=str(packed), guidance_scale=7.0)
    guidance = DiffusionGuidance.load(config)
    assert guidance.needs_base and guidance.view_grid == 2 and guidance.normal_space == "camera"
    assert guidance.picture_size("coarse") == 32 and guidance.picture_size("refined") == 256
    assert guidance.set_prompt("a dog with a flamethrower") == ["flamethrower"]
    random = torch.Generator().manual_seed(0)
    pictures = torch.rand(4, 5, 32, 32, generator=random).requires_grad_()
    views = GuidanceViews(pictures, pictures.detach(), [10.0, 100.0, 190.0, 280.0], [20.0] * 4, closeup=True)
    guidance.guide(views, 0, 10, "coarse", 1).loss.backward()
    assert pictures.grad is not None and torch.isfinite(pictures.grad).all() and pictures.grad[:, :4].abs().max() > 0
    assert builtin_folder(packed) == packed


@pytest.mark.parametrize("closeup", [False, True])
def test_a_run_speaks_to_the_prior_as_its_training_did(packed: Path, closeup: bool) -> None:
    conventions = DiffusionGuidance.load(GuidanceConfig(model=str(packed))).conventions
    for azimuth in np.linspace(0, 359, 48):
        expected = f"a cat with a crown, {view_words(float(azimuth), closeup)}"
        assert view_prompt("a cat with a crown", float(azimuth), closeup, conventions, True) == expected


def test_diffusers_loads_the_folder_too(packed: Path) -> None:
    from diffusers import StableDiffusionInstructPix2PixPipeline

    pipeline = StableDiffusionInstructPix2PixPipeline.from_pretrained(packed, local_files_only=True)
    assert pipeline.unet.config.in_channels == 9
    text = "a cow with antlers, azimuth15"
    own = DiffusionGuidance.load(GuidanceConfig(model=str(packed))).components.tokenizer
    assert pipeline.tokenizer(text).input_ids == own(text).input_ids


def test_a_changed_file_is_noticed(packed: Path) -> None:
    path = packed / "fd_mitsuba.json"
    original = path.read_bytes()
    try:
        path.write_bytes(original.replace(b"closeup", b"close__"))
        with pytest.raises(UserError, match="changed or cut short"):
            builtin_folder(packed)
    finally:
        path.write_bytes(original)


def test_samples_of_a_prior_are_drawn_and_judged(packed: Path, tmp_path: Path) -> None:
    figures = evaluate(packed, tmp_path / "sheet.png", ["ball"], ["horn"], steps=2)
    assert {row.part for row in figures} == {None, "horn"} and all(0 <= row.overlap <= 1 for row in figures)
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (3 * 64, 2 * 64)  # no part, the overview and the close-up; truth above, samples below
    with pytest.raises(UserError, match="'jetpack': no such name"):
        evaluate(packed, tmp_path / "other.png", ["ball"], ["jetpack"])
