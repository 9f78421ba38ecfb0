"""The judge of parts: a small network that sees one view before and after, and names what was added.

It shares nothing with the built-in prior but the classes: other seeds, other jitter, other pictures, no text, no noise
schedule. It is used by tests and benchmarks alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

from fd_mitsuba.prior.data.parts import PARTS

NOTHING = "none"
CLASSES = (*PARTS, NOTHING)
"""What a view may show unless a folder's `classes.json` says otherwise; `none`: nothing was added, or a blob."""
VIEW_SIZE = 32
WEIGHTS_NAME, CLASSES_NAME = "weights.safetensors", "classes.json"
_WIDTHS = (32, 64, 112, 160)


class PartNetwork(nn.Module):
    """Convolutions at 32, 16, 8 and 4 pixels, then a mean and a maximum over the picture."""

    def __init__(self, classes: Sequence[str] = CLASSES) -> None:
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


def load_classifier(folder: Path = Path(__file__).parent) -> PartClassifier:
    """The classifier of a folder with `weights.safetensors`, and `classes.json` unless it knows the coarse parts."""
    names = folder / CLASSES_NAME
    network = PartNetwork(json.loads(names.read_text(encoding="utf-8")) if names.is_file() else CLASSES)
    network.load_state_dict({key: value.float() for key, value in load_file(folder / WEIGHTS_NAME).items()})
    return PartClassifier(network)


def save_classifier(network: PartNetwork, folder: Path) -> None:
    """Write the weights as fp16."""
    state = {key: value.half() for key, value in network.state_dict().items() if value.is_floating_point()}
    state |= {key: value for key, value in network.state_dict().items() if not value.is_floating_point()}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WEIGHTS_NAME).write_bytes(save(state))
    if network.classes != CLASSES:
        (folder / CLASSES_NAME).write_text(json.dumps(network.classes) + "\n", encoding="utf-8")
