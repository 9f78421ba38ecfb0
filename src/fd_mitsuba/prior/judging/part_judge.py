"""What judges samples and runs: a classifier of parts that was trained apart from the prior.

The package has none of its own: a checkout has one in `benchmarks/part_classifier`. It sees single views of the whole
object or of the part, without and with what was added, as `prior.pictures.corpus` draws them.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Protocol

import numpy as np

from fd_mitsuba.errors import UserError

NOTHING = "none"
VIEW_SIZE = 32
"""Side in pixels of the views that it judges."""
LEAST_PIXELS = 5.0
"""A view shows a part if at least so many of its pixels change."""
CHECKOUT_CLASSIFIER = Path(__file__).resolve().parents[4] / "benchmarks" / "part_classifier"


class PartJudge(Protocol):
    """Names the part in views. `classes` are the parts of the vocabulary and `none`."""

    @property
    def classes(self) -> tuple[str, ...]: ...

    def __call__(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Probabilities (N, classes) for views (N, 4, 32, 32): normal times coverage, 2 coverage - 1."""
        ...


def load_judge(folder: Path = CHECKOUT_CLASSIFIER) -> PartJudge:
    """The classifier of a folder: `load_classifier(folder)` of its `model.py` or the one above it, which is run.

    Raises:
        UserError: no such folder, or no weights in it.
    """
    model = folder / "model.py"
    if not model.is_file():
        model = folder.parent / "model.py"
    if not model.is_file() or not (folder / "weights.safetensors").is_file():
        raise UserError(
            f"{folder}: no classifier there (model.py, weights.safetensors); give benchmarks/part_classifier of a "
            "checkout by --classifier"
        )
    name = f"part_classifier_{abs(hash(str(model.resolve())))}"
    specification = importlib.util.spec_from_file_location(name, model)
    if specification is None or specification.loader is None:
        raise UserError(f"{model}: cannot be loaded as a module")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    specification.loader.exec_module(module)
    return module.load_classifier(folder)


def views_of(mosaics: np.ndarray) -> np.ndarray:
    """The views (4 N, C, S, S) of mosaics (N, C, 2 S, 2 S), those of one mosaic together, row by row."""
    count, channels, side = *mosaics.shape[:2], mosaics.shape[2] // 2
    split = mosaics.reshape(count, channels, 2, side, 2, side)
    return split.transpose(0, 2, 4, 1, 3, 5).reshape(4 * count, channels, side, side)


def seen_by_judge(views: np.ndarray) -> np.ndarray:
    """Views (N, C, S, S) at the judge's size: means of squares of pixels where they are larger."""
    count, channels, side = views.shape[:3]
    step = side // VIEW_SIZE
    return views.reshape(count, channels, VIEW_SIZE, step, VIEW_SIZE, step).mean((3, 5))


def changed_pixels(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How many pixels of views (..., C, H, W) differ, slight differences counted in part."""
    return np.clip(np.abs(after - before).max(-3) / 0.3, 0, 1).sum((-2, -1))
