"""`render` shows the roughness that exports hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from fd_mitsuba.fields.texture import TextureValues
from fd_mitsuba.runs.appearance_outcome import as_exported, exported_noise


def test_each_part_is_as_rough_as_it_was_exported() -> None:
    learned = torch.tensor([[0.1], [0.1], [0.8], [0.1]])
    values = TextureValues(torch.rand(4, 3), learned, torch.zeros(4, 1), torch.tensor([[0.0, 0, 1]]).expand(4, 3))
    shown = as_exported(values, torch.tensor([0, 1, 1, 2]), [0.0, 3.0, 0.0])
    # A part without noise is as it was learned; alpha^2 grows by twice the slopes' variance, of mean angle 3 degrees.
    slope = np.tan(np.radians(3.0)) / np.sqrt(np.pi / 2)
    wanted = [0.1, (0.1**4 + 2 * slope**2) ** 0.25, (0.8**4 + 2 * slope**2) ** 0.25, 0.1]
    assert shown.roughness[:, 0].numpy() == pytest.approx(wanted, rel=1e-5)
    assert wanted[1] > 0.2 and shown.base_color is values.base_color and learned[1] == 0.1


def test_the_noise_is_read_from_the_export_and_damage_is_no_noise(tmp_path: Path) -> None:
    assert exported_noise(tmp_path) == {}
    (tmp_path / "export").mkdir()
    parts = {"crown": {"shading_noise_deg": 1.5}, "hat": {}, "wing": {"shading_noise_deg": "x"}, "tail": 3}
    (tmp_path / "export" / "part.json").write_text(json.dumps({"parts": parts}))
    assert exported_noise(tmp_path) == {"crown": 1.5}
    (tmp_path / "export" / "part.json").write_text(json.dumps({"parts": [1]}))
    assert exported_noise(tmp_path) == {}
