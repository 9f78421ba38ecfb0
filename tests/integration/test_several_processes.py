"""Two processes under torchrun against one: the same part, the same metrics, and one line where it cannot be."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tiny_pipelines import save_pipeline
from tiny_runs import FIELD, TEXTURE

from fd_mitsuba.backend.processes import Processes
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.guidance import picture_gradient, step_draws
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews
from fd_mitsuba.training.record import read_metrics

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "cat" / "scene.xml"
SETTINGS = f"""
{FIELD}
[geometry]
steps = 4
grid_resolution = 20
focal_samples = 256
views = 8
spp = 2
coarse_fraction = 0.5
lambda_sds = 1e-3
{TEXTURE}
[appearance]
steps = 3
views = 8
spp = 2
background = "random"
[guidance]
normalise_gradient = true
guidance_scale = 5.0
[output]
sheet_every = 0
checkpoint_every = 2
turntable_frames = 2
turntable_size = 32
texture_size = 32
"""


@pytest.mark.parametrize("augmentation", ["none", "rotation"])
def test_the_shares_of_two_add_up_to_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, augmentation: str
) -> None:
    """Timesteps, noise and turns are those that the views have in one process, and so is the mean."""
    folder = save_pipeline("sd15", tmp_path / "sd15")
    guidance = DiffusionGuidance.load(GuidanceConfig(model=str(folder), normal_augmentation=augmentation))
    guidance.set_prompt("a horse")
    pictures = torch.rand(4, 5, 16, 16, generator=torch.Generator().manual_seed(0))
    views = GuidanceViews(pictures.requires_grad_(), None, [0.0, 90.0, 180.0, 270.0], [20.0] * 4)

    def gradient(of: GuidanceViews) -> torch.Tensor:
        return torch.autograd.grad(guidance.guide(of, 2, 10, "coarse", seed=3).loss, of.pictures)[0]

    whole, shares = gradient(views), []
    for rank in range(2):
        for module in (picture_gradient, step_draws):
            monkeypatch.setattr(module, "processes", lambda rank=rank: Processes(rank, 2))
        own = Processes(rank, 2).share(4)
        part = replace(
            views,
            pictures=pictures[own].detach().requires_grad_(),
            azimuth_deg=views.azimuth_deg[own],
            elevation_deg=views.elevation_deg[own],
            share=own,
        )
        shares.append(gradient(part))
    torch.testing.assert_close(torch.cat(shares), whole, rtol=1e-4, atol=1e-6)


def started(folder: Path, name: str, count: int, *more: str) -> subprocess.CompletedProcess:
    module = ["-m", "torch.distributed.run", "--nproc-per-node", str(count)] if count > 1 else []
    (folder / "two.toml").write_text(SETTINGS)
    line = [*module, "-m", "fd_mitsuba", "run", SCENE, "-c", folder / "two.toml", "-t", "1", "-q", "-o", folder / name]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *map(str, line), *more], capture_output=True, text=True, timeout=600, env=environment
    )


@pytest.mark.slow
def test_two_processes_give_what_one_gives(tmp_path: Path) -> None:
    """With the built-in priors' mosaics, both phases, gradients normalised over all views, and random backgrounds."""
    for name, count in (("one", 1), ("two", 2)):
        done = started(tmp_path, name, count)
        assert done.returncode == 0, done.stderr[-2000:]
    for state in ("checkpoints/step_000004", "checkpoints_appearance/step_000003"):
        one, two = (load_file(tmp_path / name / f"{state}.safetensors") for name in ("one", "two"))
        fields = [key for key in one if key.startswith("field.")]
        apart = torch.cat([(one[key] - two[key]).abs().flatten() for key in fields])
        # Sums in another order differ in last digits, and Adam makes a step of a gradient that is nothing else.
        assert float((apart > 1e-5).float().mean()) < 2e-3 and apart.max() < 1e-3
    rows = [read_metrics(tmp_path / name / "metrics.jsonl") for name in ("one", "two")]
    for one, two in zip(*rows, strict=True):
        for name, value in one.items():
            if isinstance(value, float) and name != "seconds":
                assert two[name] == pytest.approx(value, rel=1e-3, abs=1e-9), (name, one["step"])
    volumes = [json.loads((tmp_path / name / "metrics.json").read_text())["inside_fraction"] for name in ("one", "two")]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-3)


@pytest.mark.slow
def test_views_that_do_not_divide_end_in_one_line(tmp_path: Path) -> None:
    done = started(tmp_path, "odd", 2, "--set", "geometry.views=4")
    lines = [line for line in done.stderr.splitlines() if line.startswith("fd_mitsuba: error")]
    assert done.returncode != 0 and len(lines) == 1
    assert "geometry.views = 4: 2 processes share them" in lines[0] and "multiple of 8" in lines[0]
    assert not (tmp_path / "odd").exists()
