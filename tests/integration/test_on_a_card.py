"""What an NVIDIA card computes, against the CPU. Skipped where torch or Dr.Jit finds no card."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.guidance.device import field_device
from fd_mitsuba.guidance.memory import available_bytes

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device"),
]

PICTURES = """
import sys
import numpy as np, torch
from fd_mitsuba.backend.startup import start
start(sys.argv[1])
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.views import CameraBatch
import trimesh
ball = trimesh.creation.icosphere(3, 0.6)
vertices = torch.tensor(np.asarray(ball.vertices, np.float32), requires_grad=True)
views = CameraBatch.around(np.array([0.0, 70.0]), 20.0, 2.5, 45.0)
weight = (vertices.detach()[:, 2] > 0.2).float()
faces = torch.from_numpy(np.asarray(ball.faces, np.int64))
pictures = GeometryPass(96, 16, 8).render(vertices, faces, weight, views, 0)
ramp = torch.linspace(-1, 1, 96)
((pictures * ramp).sum() / 96**2).backward()
np.savez(sys.argv[2], pictures=pictures.detach().numpy(), gradient=vertices.grad.numpy())
"""


def test_the_texture_field_says_and_learns_the_same() -> None:
    field = TextureField(seed=3)
    with torch.no_grad():
        field.mlp.weight_out.normal_(generator=torch.Generator().manual_seed(1))
    on_card = copy.deepcopy(field).to(field_device(GuidanceConfig(device="cuda")))
    assert on_card.grid.table.is_cuda
    points = 2 * torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) - 1
    for where in (field, on_card):
        values = where(points)
        (values.style().square().sum() + values.normal[:, 0].sum()).backward()
    assert values.base_color.device.type == "cpu"
    torch.testing.assert_close(values.style(), field(points).style(), rtol=1e-4, atol=1e-5)
    for own, other in zip(field.parameters(), on_card.parameters(), strict=True):
        assert own.grad is not None and other.grad is not None
        torch.testing.assert_close(other.grad.cpu(), own.grad, rtol=1e-3, atol=1e-4 * float(own.grad.abs().max()))


def test_the_guard_sees_what_is_taken_of_the_card() -> None:
    before = available_bytes("cuda")
    taken = torch.zeros(1 << 28, dtype=torch.uint8, device="cuda")
    after = available_bytes("cuda")
    assert before is not None and after is not None and before - after >= 0.9 * taken.nbytes


def test_pictures_and_their_gradients_agree(tmp_path: Path) -> None:
    found = {}
    for variant in ("llvm_ad_rgb", "cuda_ad_rgb"):
        file = tmp_path / f"{variant}.npz"
        command = [sys.executable, "-c", PICTURES, variant, str(file)]
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280)
        assert result.returncode == 0, result.stderr
        found[variant] = np.load(file)
    cpu, card = found["llvm_ad_rgb"], found["cuda_ad_rgb"]
    assert np.abs(cpu["pictures"] - card["pictures"]).mean() < 2e-3
    own, other = cpu["gradient"].ravel(), card["gradient"].ravel()
    assert own @ other / (np.linalg.norm(own) * np.linalg.norm(other)) > 0.99
    assert np.linalg.norm(other) == pytest.approx(np.linalg.norm(own), rel=0.05)


def test_a_run_on_the_card_ends_as_one_on_the_cpu(tmp_path: Path) -> None:
    options = {"cpu": [], "card": ["-m", "cuda_ad_rgb", "--set", "guidance.device=cuda"]}
    volumes = {}
    for name, given in options.items():
        out = tmp_path / name
        words = ["run", "scenes/cat/scene.xml", "-c", "smoke", "-o", str(out), *given]
        command = [sys.executable, "-m", "fd_mitsuba", *words]
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280)
        assert result.returncode == 0, result.stderr
        volumes[name] = json.loads((out / "metrics.json").read_text())["part_volume"]
    assert volumes["card"] == pytest.approx(volumes["cpu"], rel=0.05)


def test_a_recorded_step_of_a_training_does_what_plain_ones_do() -> None:
    from fd_mitsuba.prior.training.kinds import GEOMETRY
    from fd_mitsuba.prior.training.model import build_scheduler, build_tokenizer, tokenize
    from fd_mitsuba.prior.training.recorded_step import RecordedStep
    from fd_mitsuba.prior.training.step import TrainingStep

    tokenizer = build_tokenizer()
    tokens = tokenize(tokenizer, ["a cat with a crown", "a horse with wings"]).cuda()
    base = 2 * torch.rand(2, 4, 64, 64, generator=torch.Generator().manual_seed(1)).cuda() - 1
    batch = base, base.flip(0), (base[:, :1] > 0).float(), torch.ones(2, 1, 1, 1, device="cuda"), tokens
    losses = []
    for recorded in (False, True):
        torch.manual_seed(0)
        modules = GEOMETRY.build_modules(tokenizer).cuda()
        rate = torch.tensor(1e-3, device="cuda")
        optimiser = torch.optim.AdamW(modules.parameters(), lr=rate, fused=True, capturable=True)
        plain = TrainingStep(modules, optimiser, GEOMETRY, build_scheduler(GEOMETRY.prediction), False, 0)
        step = RecordedStep(plain, plain.generator) if recorded else plain
        losses.append(torch.stack([step(*batch).clone() for _ in range(8)]).cpu())
    torch.testing.assert_close(losses[1], losses[0], rtol=0.02, atol=1e-4)
