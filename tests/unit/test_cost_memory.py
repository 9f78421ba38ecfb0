"""The forecast of memory against measured peaks, and what is said where there is not enough."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import diffusers
import numpy as np
import pytest
import torch
import trimesh
from conftest import INTEGRATOR
from PIL import Image
from torch._subclasses.fake_tensor import FakeTensorMode

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError, out_of_memory
from fd_mitsuba.guidance.critic import Critic
from fd_mitsuba.guidance.memory import critic_bytes
from fd_mitsuba.runs import cost_memory
from fd_mitsuba.runs.cost_memory import check_memory_mb, memory_warning, refuse_too_many_samples, run_memory
from fd_mitsuba.runs.network_size import NetworkSize, network_size
from fd_mitsuba.runs.scene_size import SceneSize
from fd_mitsuba.scene.load_scene import load_edit_scene

Make = Callable[..., Path]
ROOT = Path(__file__).resolve().parents[2]
CAT = SceneSize(17012, 512 * 256, 1_916_928)
BOTH = ("geometry", "appearance")
BUILTIN = network_size("builtin")

# What changes of the cat with configs/quick.toml, and the peak of the resident set of the whole run in MiB, measured
# on 2 cores with `VmHWM`; None where it was not measured.
PEAKS = {
    "as shipped": (CAT, [], 1797, 1155),
    "all its steps": (CAT, ["geometry.steps=400"], 1626, 1163),
    "one thread": (CAT, [], 1645, 1167),
    "1.09 million faces": (SceneSize(1_088_768, 131_072, 1_916_928), [], 2341, 1958),
    "1.58 million faces": (SceneSize(1_582_912, 131_072, 1_916_928), [], 2800, None),
    "1.31 million faces around it": (SceneSize(17012, 131_072, 1_916_928, 1_310_720), [], 1839, None),
    "2.0 million faces": (SceneSize(1_999_872, 131_072, 1_916_928), [], 3538, 2850),
    "light of 4096 x 2048": (SceneSize(17012, 4096 * 2048, 1_916_928), [], 2429, 1449),
    "light of 8192 x 4096": (SceneSize(17012, 8192 * 4096, 1_916_928), [], 6462, 2547),
    "textures of 4096 x 4096": (SceneSize(17012, 131_072, 4 * 4096**2), [], 3244, 1305),
    "textures of 8192 x 8192": (SceneSize(17012, 131_072, 4 * 8192**2), [], 9238, 1796),
    "baked at 4096 x 4096": (CAT, ["output.texture_size=4096"], 4310, None),
    "grid of 128": (CAT, ["geometry.grid_resolution=128"], 1820, 1424),
}


@pytest.mark.parametrize("name", PEAKS)
def test_peaks_that_were_measured(name: str) -> None:
    size, overrides, whole, geometry = PEAKS[name]
    config = RunConfig.load(ROOT / "configs" / "quick.toml", overrides)
    assert sum(run_memory(size, config, BOTH, BUILTIN).values()) == pytest.approx(whole, rel=0.15)
    if geometry is not None:
        assert sum(run_memory(size, config, ("geometry",), BUILTIN).values()) == pytest.approx(geometry, rel=0.15)


def test_peaks_of_a_smoke_run() -> None:
    config = RunConfig.load(ROOT / "configs" / "smoke.toml", ["output.turntable_frames=2"])
    assert sum(run_memory(CAT, config, BOTH, BUILTIN).values()) == pytest.approx(1191, rel=0.15)
    assert sum(run_memory(CAT, config, ("geometry",), BUILTIN).values()) == pytest.approx(909, rel=0.15)


@pytest.mark.parametrize(
    ("size", "peak"),
    [
        (CAT, 408),
        (SceneSize(1_999_872, 131_072, 1_916_928), 1977),
        (SceneSize(17012, 131_072, 1_916_928, 1_310_720), 630),
        (SceneSize(17012, 8192 * 4096, 1_916_928), 2648),
    ],
)
def test_peaks_of_check_that_were_measured(size: SceneSize, peak: float) -> None:
    assert check_memory_mb(size) == pytest.approx(peak, rel=0.15)


def test_sizes_come_from_the_heads_of_the_files() -> None:
    assert SceneSize.of(load_edit_scene(ROOT / "scenes" / "cat" / "scene.xml")) == CAT
    values = 0
    for name in ("base_color", "roughness"):
        with Image.open(ROOT / "scenes" / "cat" / f"cat_{name}.png") as picture:
            values += np.asarray(picture).size
    assert CAT.texture_values == values


def test_meshes_around_the_base_are_counted_by_their_files(make_scene: Make, tmp_path: Path) -> None:
    """A PLY, an OBJ whose faces are counted by its lines, and a lamp."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / "ball.ply")
    (tmp_path / "box.obj").write_text(trimesh.exchange.obj.export_obj(trimesh.creation.box()))
    lamp = '<emitter type="area"><rgb name="radiance" value="1"/></emitter>'
    around = (("ply", "ball.ply", ""), ("obj", "box.obj", ""), ("ply", "ball.ply", lamp))
    shapes = "".join(
        f'<shape type="{kind}"><string name="filename" value="{name}"/><transform name="to_world">'
        f'<translate x="{9 * place}"/></transform>{more}</shape>'
        for place, (kind, name, more) in enumerate(around, start=2)
    )
    integrator = INTEGRATOR.replace("</integrator>", '<string name="base" value="body"/></integrator>')
    size = SceneSize.of(load_edit_scene(make_scene(extra=shapes, integrator=integrator)))
    assert size.faces_around == 320 + 12 + 320


def test_every_cause_is_named_where_it_is_the_largest(make_scene: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_edit_scene(make_scene())
    monkeypatch.setattr(cost_memory, "held_bytes", lambda: 0)

    def said(left: float, size: SceneSize = CAT, *overrides: str) -> str | None:
        monkeypatch.setattr(cost_memory, "available_bytes", lambda: int(left * 1e9))
        return memory_warning(scene, run_memory(size, RunConfig.load(None, list(overrides)), BOTH, NetworkSize()))

    assert said(40) is None
    builtin = ("guidance.model=builtin", "appearance.spp=8")
    assert said(4, CAT, *builtin) is None
    warning = said(1.9, CAT, *builtin) or ""
    assert "needs about 2.2 GB" in warning and warning.endswith("1.9 GB are left; free some")
    for size, override, words in (
        (SceneSize(10_000_000), (), "or take a mesh with fewer: "),
        (SceneSize(1000, 0, 0, 40_000_000), (), "or take meshes with fewer: "),
        (SceneSize(1000, 8192 * 4096), (), "or take a smaller one: "),
        (SceneSize(1000, 0, 10**9), (), "are for the scene's textures"),
        (CAT, ("output.texture_size=8192",), "or lower it: 11.8 GB are for output.texture_size"),
        (CAT, ("appearance.picture_size=4096",), "are for appearance.spp"),
        (CAT, ("output.turntable_size=2048",), "are for output.turntable_size"),
        (CAT, ("field.log2_table=24", "field.levels=32", "field.features=16"), "are for field.log2_table"),
    ):
        with pytest.raises(UserError, match="GB are left") as caught:
            said(1, size, *builtin, *override)
        assert words in str(caught.value), caught.value
    with pytest.raises(UserError, match="lower guidance.views_per_call"):
        said(1, CAT, "guidance.model=somebody/model")


def test_networks_on_another_device_are_not_held_here() -> None:
    def forecast(*overrides: str) -> float:
        config = RunConfig.load(None, ["guidance.model=somebody/model", *overrides])
        return sum(run_memory(CAT, config, BOTH, NetworkSize()).values())

    assert forecast("guidance.device=cuda") < forecast() - 5000
    assert forecast("guidance.views_per_call=1") < forecast() - 3000


def test_pictures_that_cannot_be_rendered_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_too_many_samples(4, 256, 128, "--size 256")
    with pytest.raises(UserError, match="more than Dr.Jit can number"):
        refuse_too_many_samples(4, 4096, 4096, "--size 4096 --spp 4096")
    monkeypatch.setattr(cost_memory, "available_bytes", lambda: 10**9)
    with pytest.raises(UserError, match=r"--spp 99: 4 pictures at once are 103809024 samples, 6.1 GB"):
        refuse_too_many_samples(4, 512, 99, "--spp 99")


def test_failed_allocations_are_recognised() -> None:
    for allocate in (lambda: np.empty(10**15), lambda: torch.empty(10**15), lambda: torch.empty(2**62, 2**62)):
        with pytest.raises((MemoryError, RuntimeError)) as caught:
            allocate()
        assert "out of memory" in str(out_of_memory(caught.value))
    assert "out of memory; free" in str(out_of_memory(MemoryError()))
    assert out_of_memory(RuntimeError("shape mismatch")) is None


def test_a_failed_allocation_is_one_line(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Within the steps, before the first checkpoint: no folder is left, so the same command can be repeated."""
    monkeypatch.setattr("fd_mitsuba.training.geometry_stage.GeometryStage.step", lambda *_: np.empty(10**15))
    words = ["run", str(make_scene()), "-c", "quick", "-q", "-o", str(tmp_path / "out"), "--stage", "geometry"]
    assert main([*words, "--set", "geometry.lambda_sds=0", "--set", "geometry.grid_resolution=16"]) == 1
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "out of memory" in error and "Unable to allocate" in error
    assert not (tmp_path / "out").exists()


def test_a_run_that_cannot_fit_is_refused_before_it_starts(make_scene: Make, tmp_path: Path) -> None:
    """Dr.Jit does not survive an allocation that fails, so the limit of the process is asked first."""
    scene = make_scene()
    words = [sys.executable, "-m", "fd_mitsuba", "run", str(scene), "-q", "-o", str(tmp_path / "out")]
    for item in ("output.texture_size=8192", "appearance.lambda_sds=0", "geometry.lambda_sds=0", "geometry.steps=2"):
        words += ["--set", item]
    limited = ["bash", "-c", 'ulimit -v 6000000; exec "$@"', "bash", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(limited, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert "GB of memory at its peak" in done.stderr and "are for output.texture_size" in done.stderr
    assert not (tmp_path / "out").exists()


def saved_by_the_critic(unet: dict[str, object], side: int, dtype: torch.dtype) -> tuple[int, int]:
    """Bytes that autograd keeps for the way back through a full-width UNet, and the critic's values; nothing is run."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        with FakeTensorMode(allow_non_fake_inputs=True):
            network = diffusers.UNet2DConditionModel(**unet).requires_grad_(False).eval()
            critic = Critic(network, 4, 1e-4)
            own = {weight.untyped_storage()._cdata for weight in network.parameters()}
            kept: dict[int, torch.Tensor] = {}

            def keep(value: torch.Tensor) -> torch.Tensor:
                if value.untyped_storage()._cdata not in own:
                    kept[value.untyped_storage()._cdata] = value
                return value

            texts = torch.randn(1, 77, network.config.cross_attention_dim, dtype=dtype)
            with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value), critic.acting():
                network(torch.randn(1, 4, side, side, dtype=dtype), torch.tensor([5]), texts)
            values = sum(matrix.numel() for matrix in critic._matrices.values())
            return sum(value.untyped_storage().nbytes() for value in kept.values()), values
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize(("side", "dtype"), [(96, "float32"), (64, "bfloat16")])
def test_the_critic_of_vsd_is_counted(side: int, dtype: str) -> None:
    unet = {"block_out_channels": (320, 640, 1280, 1280), "cross_attention_dim": 768, "attention_head_dim": 8}
    kept, values = saved_by_the_critic(unet, side, getattr(torch, dtype))
    assert critic_bytes(unet, side, 3, dtype, 4) == pytest.approx(3 * kept + 16 * values, rel=0.05)
    assert critic_bytes(unet, side, 3, dtype, 0) == 0


def test_the_forecast_and_the_guard_know_of_the_critic() -> None:
    def forecast(*more: str) -> float:
        config = RunConfig.load(None, ["guidance.model=somebody/model", "guidance.views_per_call=4", *more])
        return sum(run_memory(CAT, config, BOTH, NetworkSize()).values()) * 2**20

    learned = critic_bytes({}, 64, 2, "float32", 4)
    assert forecast("guidance.variant=vsd") - forecast() == pytest.approx(learned) and learned > 3e9
    assert forecast("guidance.variant=vsd", "guidance.device=cuda") == forecast("guidance.device=cuda")
