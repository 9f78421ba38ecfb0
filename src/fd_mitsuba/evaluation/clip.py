"""CLIP similarity and CLIP direction: how well pictures fit a text, and an edit the change of texts.

The model is the built-in evaluator unless a folder or hub id names another (`openai/clip-vit-base-patch32` for the
paper's). Figures of different models cannot be compared, so whoever reports one names the model beside it.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity, interpolate, normalize

from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.clip_loading import locate_clip, open_clip, read_clip_conventions, read_preprocessing

if TYPE_CHECKING:
    from transformers import CLIPModel

_PICTURES_AT_ONCE = 64


@dataclass(frozen=True)
class Preprocessing:
    """How a CLIP wants its pictures: shorter side `resize`, the middle `crop` (pixels), then (x - mean) / std."""

    resize: int
    crop: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]

    def __call__(self, pictures: Tensor) -> Tensor:
        """(N, 3, crop, crop) of sRGB pictures (N, 3, H, W) in [0, 1]; resized by an antialiased bicubic filter."""
        height, width = pictures.shape[-2:]
        scale = self.resize / min(height, width)
        size = (max(self.crop, int(height * scale)), max(self.crop, int(width * scale)))
        if size != (height, width):
            pictures = interpolate(pictures, size=size, mode="bicubic", antialias=True, align_corners=False)
        top, left = (size[0] - self.crop) // 2, (size[1] - self.crop) // 2
        cropped = pictures[..., top : top + self.crop, left : left + self.crop].clamp(0, 1)
        mean, std = (torch.tensor(values, dtype=cropped.dtype).view(3, 1, 1) for values in (self.mean, self.std))
        return (cropped - mean) / std


class ClipJudge:
    """A CLIP model with its tokenizer and preprocessing, without gradients.

    Attributes:
        name: what to write beside a figure: `built-in evaluator`, or the folder or hub id.
        version: changes with the weights, so that figures of a retrained model are not taken for the old one's.
        geometry_pictures: what this model wants to see of a shape without colours: camera-space normals as colours
            (n + 1) / 2 on black, or something shaded, as any CLIP of photographs does.
    """

    def __init__(
        self,
        model: CLIPModel,
        tokenizer: Any,
        preprocessing: Preprocessing,
        name: str,
        geometry_pictures: Literal["normals", "shaded"] = "shaded",
        whole_words: bool = False,
    ) -> None:
        self.name, self.geometry_pictures = name, geometry_pictures
        self.version = _version(model)
        self._model, self._tokenizer, self._prepare = model.eval().requires_grad_(False), tokenizer, preprocessing
        self._whole_words = whole_words

    @classmethod
    def load(cls, model: str | None = None) -> ClipJudge:
        """The built-in evaluator (None), or the CLIP model in a folder or under a hub id (fetched, unless offline).

        Raises:
            UserError: one line that names the folder, file or id and what to do.
        """
        folder, name = locate_clip(model)
        conventions = read_clip_conventions(folder)
        preprocessing = Preprocessing(*read_preprocessing(folder))
        network, tokenizer = open_clip(folder)
        settings: Any = network.config
        side = settings.vision_config.image_size
        if preprocessing.crop != side:
            raise UserError(
                f"{folder / 'preprocessor_config.json'}: pictures of {preprocessing.crop} pixels, but the model takes "
                f"{side}; copy or fetch the model again"
            )
        return cls(network, tokenizer, preprocessing, name, **conventions)

    @torch.no_grad()
    def images(self, pictures: Tensor) -> Tensor:
        """Features (N, D) float32, not normalised, of sRGB pictures (N, 3, H, W) in [0, 1].

        Raises:
            ValueError: another shape.
        """
        if pictures.ndim != 4 or pictures.shape[1] != 3 or not len(pictures):
            raise ValueError(f"pictures must be (N, 3, H, W), not {tuple(pictures.shape)}")
        with network_threads():
            chunks = pictures.detach().float().split(_PICTURES_AT_ONCE)
            return torch.cat([_pooled(self._model.get_image_features(self._prepare(chunk))) for chunk in chunks])

    @torch.no_grad()
    def texts(self, texts: list[str]) -> Tensor:
        """Features (N, D) float32, not normalised; a text longer than the model takes is cut."""
        settings: Any = self._model.config
        length = min(self._tokenizer.model_max_length, settings.text_config.max_position_embeddings)
        tokens = self._tokenizer(
            list(texts), padding="max_length", max_length=length, truncation=True, return_tensors="pt"
        )
        with network_threads():
            return _pooled(self._model.get_text_features(tokens.input_ids, tokens.attention_mask))

    @property
    def scale(self) -> float:
        """What the cosines were multiplied with in its training, before the softmax over texts."""
        return float(self._model.logit_scale.exp())

    def unknown_words(self, text: str) -> list[str]:
        """Words that the model has never seen; always none where it has CLIP's own vocabulary."""
        words = dict.fromkeys(re.findall(r"[^\W\d_]+", text.lower())) if self._whole_words else {}
        return [word for word in words if len(self._tokenizer.tokenize(word)) > 1]


def cosines(image_features: Tensor, text_features: Tensor) -> Tensor:
    """Cosines (N, M) between the rows of (N, D) and (M, D): CLIP_sim is the mean of a column."""
    return normalize(image_features, dim=-1) @ normalize(text_features, dim=-1).T


@dataclass(frozen=True)
class ClipDirection:
    """How an edit's change of pictures agrees with the change of texts, for each view (N,)."""

    cosine: Tensor
    """Of the angle between the two changes, in [-1, 1]; 0 where one of them vanishes (StyleGAN-NADA)."""
    dot: Tensor
    """Dot product of the two changes as they are: the paper's numbers, about .02 to .05 with ViT-B/32."""


def clip_direction(image_after: Tensor, image_before: Tensor, text_after: Tensor, text_before: Tensor) -> ClipDirection:
    """CLIP_dir of features (N, D) of the same views after and before, and of two texts (D,).

        d_I = i_after / |i_after| - i_before / |i_before|,  d_T likewise;  cosine = d_I d_T / |d_I||d_T|,  dot = d_I d_T

    (paper, "Evaluation Criteria"; its figures are the dot products, averaged over views).
    """
    image = normalize(image_after, dim=-1) - normalize(image_before, dim=-1)
    text = (normalize(text_after, dim=-1) - normalize(text_before, dim=-1)).reshape(1, -1)
    return ClipDirection(cosine_similarity(image, text, dim=-1), (image * text).sum(-1))


def _version(model: torch.nn.Module) -> str:
    """A digest of the small tensors, such as norms and biases: any training changes them, and they are soon read."""
    digest = hashlib.sha256()
    for tensor in model.state_dict().values():
        if tensor.numel() < 1 << 16:
            digest.update(tensor.float().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _pooled(output: Any) -> Tensor:
    # Transformers 5 hands over the whole output, its fourth version the features alone.
    return (output if isinstance(output, Tensor) else output.pooler_output).float()
