"""The judge of parts: a small network that sees one view before and after, and names what was added.

It shares nothing with the built-in priors but their words: other seeds, other distortions, other pictures, no text, no
noise schedule (`prior.pictures.part_corpus`). One is shipped in `weights/part_judge` and gives a run its verdict; a
checkout has a second one in `benchmarks/part_classifier`, trained apart from the first, which benchmarks ask.

    >>> judge = load_judge()
    >>> before = after = np.zeros((1, 4, 32, 32), np.float32)
    >>> judge.classes[int(judge(before, after).argmax())]
    'none'
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from fd_mitsuba.errors import UserError, first_line
from fd_mitsuba.guidance.builtin import verify_hashes, write_hashes

NOTHING = "none"
"""What it says where nothing was added, or something that is no part: a bare region, a lump."""
VIEW_SIZE = 32
"""Side in pixels of the views that it judges."""
LEAST_PIXELS = 5.0
"""A view shows a part if at least so many of its pixels change."""
CAMERA_RADIUS = 3.0
"""Distance of the cameras of its views from what they look at, in canonical units."""
JUDGE_FOLDER = Path(__file__).resolve().parent.parent / "weights" / "part_judge"
WEIGHTS_NAME, CLASSES_NAME = "weights.safetensors", "classes.json"
_WIDTHS = (32, 64, 112, 160)


class PartJudge(Protocol):
    """Names the part in views. `classes` are parts and `none`."""

    @property
    def classes(self) -> tuple[str, ...]: ...

    def __call__(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Probabilities (N, classes) for views (N, 4, 32, 32): normal times coverage, 2 coverage - 1."""
        ...


class PartNetwork(nn.Module):
    """Convolutions at 32, 16, 8 and 4 pixels, then a mean and a maximum over the picture."""

    def __init__(self, classes: Sequence[str]) -> None:
        super().__init__()
        self.classes = tuple(classes)
        layers: list[nn.Module] = []
        before = 12
        for level, width in enumerate(_WIDTHS):
            layers += [] if level == 0 else [nn.MaxPool2d(2)]
            for _ in range(1 if level == 0 else 2):
                layers += [nn.Conv2d(before, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(True)]
                before = width
        self.features = nn.Sequential(*layers)
        self.head = nn.Linear(2 * before, len(self.classes))

    def forward(self, before: Tensor, after: Tensor) -> Tensor:
        """Logits (N, classes) of geometry views (N, 4, 32, 32): camera-space normal times coverage, 2 coverage - 1."""
        features = self.features(torch.cat([after, before, after - before], 1))
        return self.head(torch.cat([features.mean((2, 3)), features.amax((2, 3))], 1))


class PartClassifier:
    """The trained network as a function of arrays."""

    def __init__(self, network: PartNetwork) -> None:
        self.network = network.eval()

    @property
    def classes(self) -> tuple[str, ...]:
        return self.network.classes

    @torch.no_grad()
    def __call__(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Probabilities (N, classes) for float32 views (N, 4, 32, 32) without and with what was added."""
        pair = [torch.from_numpy(np.ascontiguousarray(views, np.float32)) for views in (before, after)]
        parts = [self.network(*views).softmax(1) for views in zip(*(tensor.split(256) for tensor in pair), strict=True)]
        return torch.cat(parts).numpy() if parts else np.zeros((0, len(self.classes)), np.float32)


def load_judge(folder: Path = JUDGE_FOLDER) -> PartClassifier:
    """The judge of a folder with `weights.safetensors` and `classes.json`; by default the one that is shipped.

    Raises:
        UserError: no judge there, a file that was changed, or weights that do not fit the classes.
    """
    weights, names = folder / WEIGHTS_NAME, folder / CLASSES_NAME
    if not weights.is_file() or not names.is_file():
        raise UserError(
            f"{folder}: no judge of parts there ({WEIGHTS_NAME}, {CLASSES_NAME}); make one with fd_mitsuba prior "
            "train --kind part_judge"
        )
    verify_hashes(folder)
    try:
        network = PartNetwork(json.loads(names.read_text(encoding="utf-8")))
        network.load_state_dict({key: value.float() for key, value in load_file(weights).items()})
    except (ValueError, TypeError, RuntimeError, SafetensorError) as error:
        raise UserError(f"{folder}: its judge of parts cannot be read ({first_line(error)}); train it anew") from error
    return PartClassifier(network)


def save_judge(network: PartNetwork, folder: Path) -> None:
    """Write the weights as fp16, the classes, and the hashes of both."""
    state = {
        key: (value.half() if value.is_floating_point() else value).contiguous()
        for key, value in network.state_dict().items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WEIGHTS_NAME).write_bytes(save(state))
    (folder / CLASSES_NAME).write_text(json.dumps(network.classes) + "\n", encoding="utf-8")
    write_hashes(folder, (folder / WEIGHTS_NAME, folder / CLASSES_NAME))


def changed_pixels(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How many pixels of views (..., C, H, W) differ, slight differences counted in part."""
    return np.clip(np.abs(after - before).max(-3) / 0.3, 0, 1).sum((-2, -1))
