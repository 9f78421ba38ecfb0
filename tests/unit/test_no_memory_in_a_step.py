"""An allocation that fails in the middle of a run: one line that names the settings, and no folder in the way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from fd_mitsuba.cli.main import main
from fd_mitsuba.training.geometry_stage import GeometryStage

QUICK = ["geometry.steps=4", "geometry.grid_resolution=16", "geometry.lambda_sds=0", "output.checkpoint_every=2"]


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9.3 GiB for an array"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 99 bytes"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB\nof 1"),
    ],
    ids=["numpy", "torch", "cuda"],
)
@pytest.mark.parametrize("step", [0, 3])
def test_a_step_that_runs_out_of_memory(
    make_scene: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    error: Exception,
    step: int,
) -> None:
    honest = GeometryStage.step

    def fails(stage: GeometryStage, number: int) -> object:
        if number == step:
            raise error
        return honest(stage, number)

    monkeypatch.setattr(GeometryStage, "step", fails)
    folder = tmp_path / "run"
    chosen = [word for setting in QUICK for word in ("--set", setting)]
    assert main(["run", str(make_scene()), "-c", "smoke", *chosen, "-o", str(folder), "-q", "--stage", "geometry"]) == 1
    lines = [line for line in capfd.readouterr().err.splitlines() if "memory" in line]
    assert len(lines) == 1 and f"step {step + 1}: out of memory" in lines[0] and "guidance.views_per_call" in lines[0]
    assert "Traceback" not in lines[0]
    if step == 0:
        assert not folder.exists() and "the same -o can be used again" in lines[0]
    else:
        assert "state after step 2" in lines[0]
