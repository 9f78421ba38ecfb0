"""LoRA files and learned words on top of a random model of Stable Diffusion's layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import diffusers
import pytest
import torch
from safetensors.torch import save_file
from tiny_pipelines import save_pipeline
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.loading import Components, load_components
from fd_mitsuba.guidance.prompts import TextEmbeddings

ATTENTION = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q"
OUT = "mid_block.attentions.0.transformer_blocks.0.attn2.to_out.0"
CONVOLUTION = "down_blocks.1.resnets.0.conv1"
TEXT = "text_model.encoder.layers.1.self_attn.v_proj"
RANK = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pipeline("sd15", tmp_path_factory.mktemp("model") / "sd15")


def load(folder: Path, **settings: object) -> Components:
    return load_components(GuidanceConfig(model=str(folder), **settings))


@pytest.fixture(scope="module")
def plain(folder: Path) -> Components:
    return load(folder)


def weight_of(components: Components, component: str, place: str) -> Tensor:
    model = getattr(components, component)
    return model.get_submodule(place.removeprefix("text_model.")).weight


@pytest.fixture(scope="module")
def matrices(plain: Components) -> dict[tuple[str, str], tuple[Tensor, Tensor]]:
    """(component, layer) -> down and up."""
    generator = torch.Generator().manual_seed(0)
    found = {}
    for component, place in (("unet", ATTENTION), ("unet", OUT), ("unet", CONVOLUTION), ("text_encoder", TEXT)):
        outputs, inputs, *kernel = weight_of(plain, component, place).shape
        down = torch.randn(RANK, inputs, *kernel, generator=generator)
        found[component, place] = down, torch.randn(outputs, RANK, *[1] * len(kernel), generator=generator)
    return found


def peft(component: str, place: str) -> tuple[str, str]:
    return f"{component}.{place}.lora_A.weight", f"{component}.{place}.lora_B.weight"


def older(component: str, place: str) -> tuple[str, str]:
    if "attn" in place and component == "unet":
        layer, _, name = place.removesuffix(".0").rpartition(".")
        stem = f"{component}.{layer}.processor.{name}_lora"
    else:
        stem = f"{component}.{place}.lora" + ("_linear_layer" if component != "unet" else "")
    return f"{stem}.down.weight", f"{stem}.up.weight"


def kohya(component: str, place: str) -> tuple[str, str]:
    stem = ("lora_unet_" if component == "unet" else "lora_te_") + place.replace(".", "_")
    return f"{stem}.lora_down.weight", f"{stem}.lora_up.weight"


@pytest.mark.parametrize(("names", "alpha"), [(peft, None), (peft, 6.0), (older, None), (kohya, 6.0)])
def test_a_lora_is_added_whoever_wrote_it(
    folder: Path, plain: Components, matrices: dict, tmp_path: Path, names: Callable, alpha: float | None
) -> None:
    """W + scale (alpha / rank) up down in the four layers, nothing elsewhere; a convolution is a matrix, too."""
    content, metadata = {}, {}
    for (component, place), (down, up) in matrices.items():
        keys = names(component, place)
        content.update(zip(keys, (down, up), strict=True))
        if alpha is not None and names is kohya:
            content[keys[0].removesuffix(".lora_down.weight") + ".alpha"] = torch.tensor(alpha)
    if alpha is not None and names is peft:
        settings = {f"{component}.lora_alpha": alpha for component in ("unet", "text_encoder")}
        metadata = {"lora_adapter_metadata": json.dumps(settings)}
    file = tmp_path / "pytorch_lora_weights.safetensors"
    save_file(content, file, metadata={"format": "pt", **metadata})
    changed = load(folder, lora=(str(tmp_path),), lora_scale=0.7)
    factor = 0.7 * (1 if alpha is None else alpha / RANK)
    for (component, place), (down, up) in matrices.items():
        product = torch.einsum("or,ri->oi", up.flatten(1), down.flatten(1)).view_as(weight_of(plain, component, place))
        expected = weight_of(plain, component, place) + factor * product
        torch.testing.assert_close(weight_of(changed, component, place), expected, rtol=1e-5, atol=1e-5)
    for component in ("unet", "text_encoder"):
        before, now = (getattr(which, component).state_dict() for which in (plain, changed))
        places = [place.removeprefix("text_model.") for owner, place in matrices if owner == component]
        assert {key for key in now if not now[key].equal(before[key])} == {f"{place}.weight" for place in places}


def test_a_lora_changes_what_the_guidance_says(folder: Path, matrices: dict, tmp_path: Path) -> None:
    down, up = matrices["unet", ATTENTION]
    save_file(dict(zip(peft("unet", ATTENTION), (down, up), strict=True)), tmp_path / "a.safetensors")
    z, t, text = torch.randn(1, 4, 16, 16), torch.tensor([300]), torch.randn(1, 77, 48)
    with torch.no_grad():
        outputs = [
            load(folder, lora=(str(tmp_path / "a.safetensors"),), lora_scale=scale).unet(z, t, text).sample
            for scale in (0.0, 1.0)
        ]
    assert not torch.allclose(*outputs, atol=1e-4)


def wide(down: Tensor, up: Tensor) -> dict[str, Tensor]:
    return dict(zip(peft("unet", ATTENTION), (torch.cat([down, down], 1), up), strict=True))


def pair(down: Tensor, up: Tensor) -> dict[str, Tensor]:
    return dict(zip(peft("unet", ATTENTION), (down.contiguous(), up.contiguous()), strict=True))


BAD: dict[str, tuple[Callable[[Tensor, Tensor], dict[str, Tensor]], str]] = {
    "other widths": (wide, r"matrices \(3, 64\) and \(32, 3\) for a weight \(32, 32\); it was made for another one"),
    "other layers": (
        lambda down, up: dict(zip(peft("unet", ATTENTION.replace("attn1", "attn9")), (down, up), strict=True)),
        "does not have; it was made for another one",
    ),
    "half": (lambda down, up: {peft("unet", ATTENTION)[0]: down}, "lacks one of its two matrices"),
    "dora": (
        lambda down, up: (
            dict(zip(peft("unet", ATTENTION), (down, up), strict=True))
            | {f"unet.{ATTENTION}.lora_magnitude_vector": down + 1}
        ),
        "no part of a plain LoRA",
    ),
    "a whole model": (lambda down, up: {"conv_in.weight": down}, "conv_in.weight is no part of a plain LoRA"),
    "sdxl": (lambda down, up: {"lora_te2_x.lora_down.weight": down}, "no part of a plain LoRA"),
    "empty": (lambda down, up: {}, "holds no LoRA"),
    "rank 0": (lambda down, up: pair(down[:0], up[:, :0]), r"\(0, 32\) and \(32, 0\) are no two matrices of a rank"),
    "vectors": (lambda down, up: pair(down[0], up[:, 0]), r"\(32,\) and \(32,\) are no two matrices"),
    "numbers": (lambda down, up: pair(torch.tensor(1.0), torch.tensor(2.0)), r"\(\) and \(\) are no two matrices"),
    "three alphas": (lambda down, up: {"lora_unet_x.alpha": torch.ones(3)}, "lora_unet_x.alpha has 3 values, not one"),
    "nan": (lambda down, up: pair(down / 0, up), "lora_A.weight has values that are not finite"),
    "infinite alpha": (
        lambda down, up: {"lora_unet_x.alpha": torch.tensor(float("inf"))},
        "lora_unet_x.alpha has values that are not finite",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_lora_that_does_not_fit_is_one_line(folder: Path, matrices: dict, tmp_path: Path, case: str) -> None:
    content, expected = BAD[case]
    file = tmp_path / "a.safetensors"
    save_file(content(*matrices["unet", ATTENTION]), file)
    with pytest.raises(UserError, match=expected) as caught:
        load(folder, lora=(str(file),))
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("[1]", "lora_adapter_metadata is no JSON object"),
        ("[" * 99_999, "lora_adapter_metadata is not JSON"),
        ('{"unet.lora_alpha": "big"}', "its unet.lora_alpha is 'big', not a finite number"),
        ('{"unet.lora_alpha": null}', "its unet.lora_alpha is None"),
        ('{"unet.lora_alpha": true}', "its unet.lora_alpha is True"),
        ('{"text_encoder.lora_alpha": NaN}', "its text_encoder.lora_alpha is nan"),
    ],
)
def test_settings_of_an_adapter_that_say_nothing(
    folder: Path, matrices: dict, tmp_path: Path, said: str, expected: str
) -> None:
    file = tmp_path / "a.safetensors"
    save_file(pair(*matrices["unet", ATTENTION]), file, metadata={"lora_adapter_metadata": said})
    with pytest.raises(UserError, match=expected) as caught:
        load(folder, lora=(str(file),))
    assert str(file) in str(caught.value)


def test_a_lora_is_added_once(folder: Path, matrices: dict, tmp_path: Path) -> None:
    file = tmp_path / "a.safetensors"
    save_file(pair(*matrices["unet", ATTENTION]), file)
    with pytest.raises(UserError, match="is named twice in guidance.lora"):
        load(folder, lora=(str(file), str(tmp_path)))


def test_files_that_are_no_lora(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rubbish.safetensors").write_bytes(b"rubbish" * 99)
    (tmp_path / "old.bin").touch()
    (tmp_path / "none").mkdir()
    for name, expected in {
        "rubbish.safetensors": "damaged",
        "old.bin": "no .safetensors file",
        "none": "holds 0 .safetensors",
        "missing": "no such file or folder",
    }.items():
        with pytest.raises(UserError, match=expected):
            load(folder, lora=(str(tmp_path / name),))
    with pytest.raises(UserError, match="made for Stable Diffusion"):
        load_components(GuidanceConfig(model="builtin", lora=("x",)))


@pytest.mark.parametrize("vectors", [1, 3])
def test_a_learned_word_is_read_as_diffusers_reads_it(folder: Path, tmp_path: Path, vectors: int) -> None:
    file = tmp_path / "learned_embeds.safetensors"
    learned = torch.randn(vectors, 48, generator=torch.Generator().manual_seed(1))
    save_file({"<my-crown>": learned if vectors > 1 else learned[0]}, file)
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(folder, safety_checker=None)
    before = pipeline.encode_prompt("a horse with a <my-crown>", "cpu", 1, False)[0]
    pipeline.load_textual_inversion(str(file))
    expected = pipeline.encode_prompt("a horse with a <my-crown>", "cpu", 1, False)[0]
    components = load(folder, words=(str(tmp_path),))
    read = TextEmbeddings(components.tokenizer, components.text_encoder, words=components.words)
    torch.testing.assert_close(read(["a horse with a <my-crown>"]), expected, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(before, expected, atol=1e-3)
    torch.testing.assert_close(read(["a horse"]), pipeline.encode_prompt("a horse", "cpu", 1, False)[0])


def test_words_that_do_not_fit_are_one_line(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "a.safetensors"
    for content, expected in (
        ({"<x>": torch.zeros(1, 64)}, r"vectors \(1, 64\), but this model's words have 48 numbers"),
        ({"horse</w>": torch.zeros(1, 48)}, "knows 'horse</w>' already"),
        ({"<x>": torch.zeros(1, 48), "<y>": torch.zeros(1, 48)}, "holds 2 tensors"),
        ({"<x>": torch.zeros(0, 48)}, r"holds no vectors \(0, 48\)"),
        ({"<x>": torch.tensor(1.0)}, r"vectors \(\), but"),
        ({"": torch.zeros(1, 48)}, "its word is ''"),
        ({" ": torch.zeros(1, 48)}, "its word is ' '"),
        ({"<x>": torch.full((1, 48), torch.inf)}, "<x> has values that are not finite"),
    ):
        save_file(content, file)
        with pytest.raises(UserError, match=expected):
            load(folder, words=(str(file),))
