from __future__ import annotations

import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from transformers import AutoTokenizer, CLIPConfig, CLIPImageProcessorPil, CLIPModel

from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation import clip_loading
from fd_mitsuba.evaluation.clip import ClipJudge, clip_direction, cosines
from fd_mitsuba.prior.training.clip_model import build_clip_tokenizer

TEXTS = ["a horse with wings", "a picture of a mug", "cat, crown"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny CLIP with random weights, saved by Transformers; pictures of 32 pixels, resized to 40 before the crop."""
    path = tmp_path_factory.mktemp("clip")
    tokenizer = build_clip_tokenizer()
    text = {"vocab_size": len(tokenizer), "hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2}
    text |= {"num_attention_heads": 2, "max_position_embeddings": 24, "eos_token_id": 1, "bos_token_id": 0}
    vision = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    vision |= {"image_size": 32, "patch_size": 8}
    torch.manual_seed(0)
    CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=12)).save_pretrained(path)
    tokenizer.save_pretrained(path)
    CLIPImageProcessorPil(size={"shortest_edge": 40}, crop_size=32).save_pretrained(path)
    return path


def test_features_are_those_of_transformers_own_pipeline(folder: Path) -> None:
    judge, model = ClipJudge.load(str(folder)), CLIPModel.from_pretrained(folder).eval()
    rng = np.random.default_rng(0)
    smooth = rng.random((3, 5, 7, 3)).repeat(16, 1).repeat(16, 2)
    pictures = np.rint(255 * smooth).astype(np.uint8)
    processor = CLIPImageProcessorPil.from_pretrained(folder)
    prepared = processor([Image.fromarray(p) for p in pictures], return_tensors="pt")
    tokens = AutoTokenizer.from_pretrained(folder)(TEXTS, padding=True, return_tensors="pt")
    with torch.no_grad():
        image = model.get_image_features(**prepared).pooler_output
        text = model.get_text_features(tokens.input_ids, tokens.attention_mask).pooler_output
    mine = judge.images(torch.from_numpy(pictures).permute(0, 3, 1, 2) / 255)
    assert torch.nn.functional.cosine_similarity(mine, image).min() > 0.9999  # Pillow rounds to bytes after resizing
    assert (mine - image).norm(dim=1).max() < 0.02 * image.norm(dim=1).min()
    torch.testing.assert_close(judge.texts(TEXTS), text, atol=1e-5, rtol=1e-5)
    by_hand = (mine[1] @ text[2]) / (mine[1].norm() * text[2].norm())
    assert cosines(mine, judge.texts(TEXTS))[1, 2] == pytest.approx(by_hand.item(), abs=1e-5)


def test_pictures_of_the_models_own_size_are_only_normalised(folder: Path, tmp_path: Path) -> None:
    same = shutil.copytree(folder, tmp_path / "same")
    CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size=32).save_pretrained(same)
    pictures = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073]).view(3, 1, 1)
    std = torch.tensor([0.26862954, 0.26130258, 0.27577711]).view(3, 1, 1)
    with torch.no_grad():
        expected = CLIPModel.from_pretrained(folder).eval().get_image_features((pictures - mean) / std).pooler_output
    torch.testing.assert_close(ClipJudge.load(str(same)).images(pictures), expected, atol=1e-5, rtol=1e-5)


def test_a_text_is_read_at_its_end_and_not_at_the_padding(folder: Path) -> None:
    judge = ClipJudge.load(str(folder))
    alone, padded = judge.texts(["cat"]), judge.texts(["cat", "a picture of a cat that has a crown"])
    torch.testing.assert_close(alone[0], padded[0], atol=1e-6, rtol=1e-5)
    # A sign that the tokenizer does not know must not end the sentence.
    marked = judge.texts(["a cat! with a crown", "a cat with a crown", "a cat"])
    torch.testing.assert_close(marked[0], marked[1])
    assert not torch.allclose(marked[1], marked[2], atol=1e-4)


def test_cosines_by_hand() -> None:
    rows = torch.tensor([[3.0, 4.0], [0.0, -2.0]])
    torch.testing.assert_close(cosines(rows, torch.tensor([[1.0, 0.0]])), torch.tensor([[0.6], [0.0]]))


def test_direction_by_hand() -> None:
    """Unit features turn from (1, 0) to (0, 1); the text from (1, 0) to (0.6, 0.8); lengths must not matter."""
    after, before = torch.tensor([[0.0, 5.0], [2.0, 0.0]]), torch.tensor([[3.0, 0.0], [7.0, 0.0]])
    found = clip_direction(after, before, torch.tensor([6.0, 8.0]), torch.tensor([0.5, 0.0]))
    # d_I = (-1, 1), d_T = (-.4, .8): dot 1.2, lengths sqrt(2) and sqrt(.8). The second view did not change.
    assert found.dot.tolist() == pytest.approx([1.2, 0.0])
    assert found.cosine.tolist() == pytest.approx([1.2 / math.sqrt(1.6), 0.0])


def test_a_name_that_is_no_model_is_refused_in_one_line(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusal(model: str) -> str:
        with pytest.raises(UserError) as caught:
            ClipJudge.load(model)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert "no such folder" in refusal(str(tmp_path / "nothing"))
    assert "offline" in refusal("nobody/no-such-clip").lower()
    assert "config.json" in refusal(str(tmp_path))
    broken = shutil.copytree(folder, tmp_path / "broken")
    (broken / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:2000])
    assert str(broken) in refusal(str(broken))
    other = shutil.copytree(folder, tmp_path / "other")
    (other / "config.json").write_text(json.dumps({"model_type": "bert"}))
    assert "'bert'" in refusal(str(other))
    sizes = shutil.copytree(folder, tmp_path / "sizes")
    CLIPImageProcessorPil(size={"shortest_edge": 224}, crop_size=224).save_pretrained(sizes)
    assert "224" in refusal(str(sizes))
    (sizes / "preprocessor_config.json").unlink()
    assert "preprocessor_config.json" in refusal(str(sizes))


def test_pictures_of_another_shape_are_refused(folder: Path) -> None:
    judge = ClipJudge.load(str(folder))
    for shape in ((3, 32, 32), (1, 4, 32, 32), (0, 3, 32, 32)):
        with pytest.raises(ValueError, match="N, 3, H, W"):
            judge.images(torch.zeros(shape))


def test_a_changed_file_of_the_built_in_evaluator_is_noticed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = shutil.copytree(folder, tmp_path / "evaluator")
    monkeypatch.setattr(clip_loading, "EVALUATOR_FOLDER", copy)
    (copy / "SHA256SUMS").write_text(f"{'0' * 64}  config.json\n")
    with pytest.raises(UserError, match="changed"):
        ClipJudge.load()
    (copy / "config.json").unlink()
    with pytest.raises(UserError, match="no built-in evaluator"):
        ClipJudge.load()


def test_the_built_in_evaluator_loads_without_a_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    judge = ClipJudge.load()
    assert judge.name == "built-in evaluator" and judge.geometry_pictures == "normals"
    assert judge.unknown_words("a mossy horse with Wings") == ["mossy"]
    assert judge.texts(["a horse", "a horse with wings"]).shape == judge.images(torch.rand(2, 3, 96, 96)).shape
    files = [path for path in clip_loading.EVALUATOR_FOLDER.iterdir() if path.is_file()]
    assert sum(os.path.getsize(path) for path in files) < 8e6
    plain = CLIPModel.from_pretrained(clip_loading.EVALUATOR_FOLDER)  # the plain way of any Transformers user
    assert (
        plain.config.text_config.eos_token_id
        == AutoTokenizer.from_pretrained(clip_loading.EVALUATOR_FOLDER).eos_token_id
    )


def test_the_version_follows_the_weights() -> None:
    judge = ClipJudge.load()
    assert judge.version == ClipJudge.load().version
    judge._model.logit_scale.data += 1e-3
    again = ClipJudge(judge._model, judge._tokenizer, judge._prepare, judge.name)
    assert again.version != judge.version
