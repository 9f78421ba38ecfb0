"""Texts per view, their embeddings, and the conventions file that decides them."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.builtin import builtin_folder
from fd_mitsuba.guidance.model_conventions import ModelConventions, read_model_conventions
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.guidance.prompts import TextEmbeddings, unknown_words, view_prompt, view_word

EIGHT = tuple(f"w{index}" for index in range(8))


@pytest.mark.parametrize(
    ("azimuth", "word"),
    [
        (0, "front view"),
        (44, "front view"),
        (-44, "front view"),
        (90, "side view"),
        (270, "side view"),
        (180, "back view"),
    ],
)
def test_stock_models_read_front_side_back(azimuth: float, word: str) -> None:
    assert view_prompt("a horse", azimuth, False, ModelConventions(), True) == f"a horse, {word}"


def test_without_view_prompts_only_the_prompt_is_left() -> None:
    assert view_prompt("a horse, white", 90, True, ModelConventions(closeup_word="close"), False) == "a horse, white"


@pytest.mark.parametrize(("azimuth", "word"), [(0, "w0"), (22, "w0"), (-22, "w0"), (23, "w1"), (90, "w2"), (359, "w0")])
def test_bins_of_pictures_are_centred_on_the_front(azimuth: float, word: str) -> None:
    assert view_word(azimuth, ModelConventions(view_words=EIGHT)) == word


@pytest.mark.parametrize(
    ("azimuth", "word"), [(0, "a"), (29, "a"), (31, "b"), (89, "c"), (90, "a"), (-1, "c"), (305, "b")]
)
def test_bins_of_mosaics_repeat_every_quarter_turn(azimuth: float, word: str) -> None:
    assert view_word(azimuth, ModelConventions(view_grid=2, view_words=("a", "b", "c"))) == word


def test_first_bin_can_be_moved() -> None:
    conventions = ModelConventions(view_words=("a", "b"), view_start_deg=10)
    assert [view_word(azimuth, conventions) for azimuth in (9, 10, 189, 190)] == ["b", "a", "a", "b"]


def test_mosaics_have_no_view_word_of_their_own() -> None:
    assert view_prompt("a horse", 10, False, ModelConventions(view_grid=2), True) == "a horse"


def test_template_items_that_come_out_empty_are_dropped() -> None:
    conventions = ModelConventions(
        prompt_template="{prompt}, {closeup}, {view}, normal map", closeup_word="close", view_words=("seen",)
    )
    assert view_prompt("a horse, white", 0, True, conventions, True) == "a horse, white, close, seen, normal map"
    assert view_prompt("a horse, white", 0, False, conventions, True) == "a horse, white, seen, normal map"
    assert view_prompt("a {odd} horse", 0, False, conventions, False) == "a {odd} horse, normal map"


@pytest.mark.parametrize(
    "text",
    [
        '{"view_grid": 0}',
        '{"view_gird": 2}',
        "not json",
        '{"prompt_template": "{view}"}',
        '{"prompt_template": "{prompt} {x}"}',
    ],
)
def test_bad_conventions_file_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "fd_mitsuba.json").write_text(text)
    with pytest.raises(UserError) as caught:
        read_model_conventions(tmp_path)
    assert "fd_mitsuba.json" in str(caught.value) and "\n" not in str(caught.value)


def test_conventions_file_is_optional(tmp_path: Path) -> None:
    assert read_model_conventions(tmp_path) == ModelConventions()
    (tmp_path / "fd_mitsuba.json").write_text('{"view_grid": 2, "normal_space": "camera", "needs_base": true}')
    assert read_model_conventions(tmp_path).view_grid == 2


def test_mosaic_is_row_major_with_the_first_view_at_the_top_left() -> None:
    views = torch.arange(8.0).view(8, 1, 1, 1).expand(8, 5, 3, 3).requires_grad_()
    mosaics = tile_views(views, 2)
    assert mosaics.shape == (2, 5, 6, 6)
    assert mosaics[1, 0, ::3, ::3].tolist() == [[4, 5], [6, 7]]
    assert mosaics[0, 4, 1, 4] == 1
    mosaics.sum().backward()
    with pytest.raises(ValueError, match="multiple of 4"):
        tile_views(views[:3], 2)


class _CharacterTokenizer:
    """A token a character, which is enough to see padding, cutting and caching."""

    model_max_length = 10**30

    def __call__(self, text: str, padding: str = "", max_length: int = 0, **_: object) -> SimpleNamespace:
        ids = [ord(character) % 50 for character in text]
        if padding:
            ids = (ids + [0] * max_length)[:max_length]
            tokens = torch.tensor([ids])
            return SimpleNamespace(input_ids=tokens, attention_mask=(tokens > 0).long())
        return SimpleNamespace(input_ids=ids)

    def tokenize(self, word: str) -> list[str]:
        return [word] if word in ("a", "horse") else list(word)


class _CountingEncoder(torch.nn.Module):
    def __init__(self, use_attention_mask: bool = False) -> None:
        super().__init__()
        self.config = SimpleNamespace(max_position_embeddings=12, use_attention_mask=use_attention_mask)
        self.embedding = torch.nn.Embedding(50, 6)
        self.calls, self.masks = 0, []

    def forward(self, tokens: torch.Tensor, attention_mask: torch.Tensor | None = None) -> tuple[torch.Tensor]:
        self.calls += 1
        self.masks.append(attention_mask)
        return (self.embedding(tokens),)


def test_each_distinct_text_is_encoded_once() -> None:
    encoder = _CountingEncoder()
    embed = TextEmbeddings(_CharacterTokenizer(), encoder)
    first = embed(["a horse", "", "a horse"])
    assert first.shape == (3, 12, 6) and not first.requires_grad
    assert first[0].equal(first[2]) and not first[0].equal(first[1])
    assert embed(["", "a horse"])[1].equal(first[0])
    assert encoder.calls == 2 and encoder.masks == [None, None]


def test_mask_is_given_only_to_encoders_trained_with_one() -> None:
    encoder = _CountingEncoder(use_attention_mask=True)
    TextEmbeddings(_CharacterTokenizer(), encoder)(["abc"])
    assert encoder.masks[0].sum() == 3


def test_long_text_is_cut_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert TextEmbeddings(_CharacterTokenizer(), _CountingEncoder())(["a horse with wings"]).shape == (1, 12, 6)
    assert "12 tokens" in caplog.text


def test_words_that_the_tokenizer_splits_are_named_once() -> None:
    assert unknown_words(_CharacterTokenizer(), "A dragon, a horse; dragon 3") == ["dragon"]


def test_builtin_prior_is_checked_against_its_hashes(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no built-in prior"):
        builtin_folder(tmp_path)
    index = tmp_path / "model_index.json"
    index.write_text("{}")
    assert builtin_folder(tmp_path) == tmp_path
    sums = tmp_path / "SHA256SUMS"
    sums.write_text(f"{hashlib.sha256(b'{}').hexdigest()}  model_index.json\n\n")
    assert builtin_folder(tmp_path) == tmp_path
    index.write_text("{ }")
    with pytest.raises(UserError, match="model_index.json: .*changed"):
        builtin_folder(tmp_path)
    for line in (f"{'0' * 64}  unet/gone.safetensors", "rubbish"):
        sums.write_text(line)
        with pytest.raises(UserError, match="missing|line 1"):
            builtin_folder(tmp_path)
