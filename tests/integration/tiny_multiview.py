"""MVDream's UNet as its authors lay it out, written here with plain layers: names, joint attention, camera embedding.

Of random weights and a few channels. It is what the loaded models are compared with, so nothing of Diffusers is in it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from tiny_pipelines import build_pipeline
from torch import Tensor, nn

CONFIG: dict[str, Any] = dict(
    image_size=8,
    in_channels=4,
    out_channels=4,
    model_channels=32,
    attention_resolutions=[2, 1],
    num_res_blocks=1,
    channel_mult=[1, 2, 2],
    num_head_channels=16,
    transformer_depth=1,
    context_dim=64,
    use_checkpoint=False,
    camera_dim=16,
)
WIDTHS = [32, 64, 64]
ATTENDS = [True, True, False]


def embedding(numbers: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(numbers, 128), nn.SiLU(), nn.Linear(128, 128))


class ResBlock(nn.Module):
    def __init__(self, entering: int, leaving: int) -> None:
        super().__init__()
        first, second = (nn.Conv2d(width, leaving, 3, padding=1) for width in (entering, leaving))
        self.in_layers = nn.Sequential(nn.GroupNorm(32, entering), nn.SiLU(), first)
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(128, leaving))
        self.out_layers = nn.Sequential(nn.GroupNorm(32, leaving), nn.SiLU(), nn.Dropout(0), second)
        self.skip_connection = nn.Identity() if entering == leaving else nn.Conv2d(entering, leaving, 1)

    def forward(self, x: Tensor, known: dict[str, Tensor]) -> Tensor:
        inner = self.in_layers(x) + self.emb_layers(known["embedding"])[:, :, None, None]
        return self.skip_connection(x) + self.out_layers(inner)


class Attention(nn.Module):
    """softmax(q k / sqrt(width of a head)) v, each head on its own."""

    def __init__(self, width: int, seen: int) -> None:
        super().__init__()
        self.to_q, self.to_k, self.to_v = (nn.Linear(size, width, bias=False) for size in (width, seen, seen))
        self.to_out = nn.Sequential(nn.Linear(width, width), nn.Dropout(0))

    def forward(self, x: Tensor, seen: Tensor) -> Tensor:
        each = CONFIG["num_head_channels"]
        q, k, v = (layer(of) for layer, of in ((self.to_q, x), (self.to_k, seen), (self.to_v, seen)))
        heads = []
        for start in range(0, q.shape[-1], each):
            part = slice(start, start + each)
            scores = q[..., part] @ k[..., part].transpose(1, 2) / each**0.5
            heads.append(scores.softmax(dim=-1) @ v[..., part])
        return self.to_out(torch.cat(heads, dim=-1))


class GatedLinear(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Linear(width, 8 * width)

    def forward(self, x: Tensor) -> Tensor:
        value, gate = self.proj(x).chunk(2, dim=-1)
        return value * nn.functional.gelu(gate)


class Block(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.attn1, self.attn2 = Attention(width, width), Attention(width, CONFIG["context_dim"])
        self.ff = nn.Module()
        self.ff.net = nn.Sequential(GatedLinear(width), nn.Dropout(0), nn.Linear(4 * width, width))
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(width) for _ in range(3))

    def forward(self, x: Tensor, known: dict[str, Tensor]) -> Tensor:
        group, groups = known["group"], []
        for start in range(0, len(x), group):
            views = list(self.norm1(x[start : start + group]))
            joined = torch.cat(views)[None]  # all tokens of all views, one after the other
            groups += self.attn1(joined, joined)[0].chunk(group)
        x = x + torch.stack(groups)
        x = x + self.attn2(self.norm2(x), known["texts"])
        return x + self.ff.net(self.norm3(x))


class Transformer(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.proj_in = nn.GroupNorm(32, width, eps=1e-6), nn.Linear(width, width)
        self.transformer_blocks, self.proj_out = nn.ModuleList([Block(width)]), nn.Linear(width, width)

    def forward(self, x: Tensor, known: dict[str, Tensor]) -> Tensor:
        tokens = self.proj_in(self.norm(x).flatten(2).transpose(1, 2))
        return x + self.proj_out(self.transformer_blocks[0](tokens, known)).transpose(1, 2).reshape(x.shape)


class Downsample(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.op = nn.Conv2d(width, width, 3, stride=2, padding=1)

    def forward(self, x: Tensor, known: dict[str, Tensor]) -> Tensor:
        return self.op(x)


class Upsample(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor, known: dict[str, Tensor]) -> Tensor:
        return self.conv(x.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3))


class First(nn.Conv2d):
    def forward(self, x: Tensor, known: dict[str, Tensor]) -> Tensor:
        return super().forward(x)


class MultiViewUNet(nn.Module):
    """Noise (N, 4, 8, 8) that is seen in N views; `group` consecutive ones are seen at once."""

    def __init__(self) -> None:
        super().__init__()
        self.time_embed, self.camera_embed = embedding(32), embedding(CONFIG["camera_dim"])
        self.input_blocks = nn.ModuleList([nn.ModuleList([First(4, 32, 3, padding=1)])])
        width, kept = 32, [32]
        for level, leaving in enumerate(WIDTHS):
            self.input_blocks.append(self._layers(width, leaving, ATTENDS[level]))
            width = leaving
            kept.append(width)
            if level < len(WIDTHS) - 1:
                self.input_blocks.append(nn.ModuleList([Downsample(width)]))
                kept.append(width)
        self.middle_block = nn.ModuleList([ResBlock(width, width), Transformer(width), ResBlock(width, width)])
        self.output_blocks = nn.ModuleList()
        for level in reversed(range(len(WIDTHS))):
            for number in range(2):
                layers = self._layers(width + kept.pop(), WIDTHS[level], ATTENDS[level])
                width = WIDTHS[level]
                if level and number:
                    layers.append(Upsample(width))
                self.output_blocks.append(layers)
        self.out = nn.Sequential(nn.GroupNorm(32, width), nn.SiLU(), nn.Conv2d(width, 4, 3, padding=1))

    def forward(self, x: Tensor, times: Tensor, texts: Tensor, cameras: Tensor, group: int) -> Tensor:
        rates = torch.exp(-torch.arange(16) / 16 * torch.log(torch.tensor(10000.0)))
        angles = times[:, None] * rates
        timestep = self.time_embed(torch.cat([angles.cos(), angles.sin()], dim=1))
        known: dict[str, Any] = {"embedding": timestep + self.camera_embed(cameras), "texts": texts, "group": group}
        kept = []
        for layers in self.input_blocks:
            x = self._through(layers, x, known)
            kept.append(x)
        x = self._through(self.middle_block, x, known)
        for layers in self.output_blocks:
            x = self._through(layers, torch.cat([x, kept.pop()], dim=1), known)
        return self.out(x)

    @staticmethod
    def _layers(entering: int, leaving: int, attends: bool) -> nn.ModuleList:
        return nn.ModuleList([ResBlock(entering, leaving), *([Transformer(leaving)] if attends else [])])

    @staticmethod
    def _through(layers: nn.ModuleList, x: Tensor, known: dict[str, Any]) -> Tensor:
        for layer in layers:
            x = layer(x, known)
        return x


def made_unet(seed: int = 11) -> MultiViewUNet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        unet = MultiViewUNet()
        nn.init.normal_(unet.camera_embed[0].weight, std=0.5)  # so that cameras make a difference that is seen
        return unet.eval().requires_grad_(False)


def save_multiview(folder: Path, conventions: dict[str, object] | None = None) -> Path:
    """A pipeline folder as it is published: text encoder and VAE of Stable Diffusion 2.1, this UNet, predicts e."""
    build_pipeline("sd21", with_unet=False).save_pretrained(folder)
    unet = folder / "unet"
    unet.mkdir()
    (unet / "config.json").write_text(json.dumps({"_class_name": "MultiViewUNetModel"} | CONFIG))
    save_file(made_unet().state_dict(), unet / "diffusion_pytorch_model.safetensors")
    edit(folder / "model_index.json", _class_name="MVDreamPipeline", unet=["mv_unet", "MultiViewUNetModel"])
    edit(folder / "scheduler" / "scheduler_config.json", prediction_type="epsilon")
    if conventions is not None:
        (folder / "fd_mitsuba.json").write_text(json.dumps(conventions))
    return folder


def edit(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
