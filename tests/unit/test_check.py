from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import BASE, write_ply
from PIL import Image

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import GeometryConfig, GuidanceConfig, RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.memory import working_set_bytes
from fd_mitsuba.guidance.speed import measured_speed
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.runs.cost import LIT_PICTURES_SECONDS, PHOTOGRAPHS_SECONDS, START_AND_EXPORT_SECONDS, estimate_cost
from fd_mitsuba.runs.geometry_outcome import prepare_geometry
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.viewing.preview import preview_scene, region_colours

Make = Callable[..., Path]
ROOT = Path(__file__).resolve().parents[2]


def ball(scale: str, x: float, y: float, z: float, part: str = "part") -> str:
    return f"""<shape type="focal_region" id="ball"><string name="part" value="{part}"/><transform name="to_world">
      <scale value="{scale}"/><translate x="{x}" y="{y}" z="{z}"/></transform></shape>"""


def warnings(path: Path, config: RunConfig | None = None) -> str:
    return "\n".join(check_scene(load_edit_scene(path), config or RunConfig()).warnings)


def test_a_good_scene_has_no_warnings(make_scene: Make) -> None:
    report = check_scene(load_edit_scene(make_scene(region=ball("0.15", 0, 0.3, 0))), RunConfig.load("quick"))
    assert report.warnings == () and report.base_closed
    (base,), (region,) = report.base, report.regions
    assert base.topology.closed and base.topology.components == 1 and base.volume > 0
    assert region.share_in_grid == 1.0 and region.gap_to_base == 0.0 and 0 < region.share_in_base < 0.9
    cell = 2.1 / 64
    assert region.thickness_cells == pytest.approx(0.3 * 1.8 / report.longest_side / cell, rel=1e-5)
    assert region.volume_cells == pytest.approx(np.pi / 6 * region.thickness_cells**3, rel=1e-5)


def test_a_region_that_stands_out_of_the_grid_gets_room(make_scene: Make) -> None:
    """A ball whose top 8 % of a radius lie above the grid would lose half a percent: h^2 (3 - h) / 4 of its volume."""
    report = check_scene(load_edit_scene(make_scene(region=ball("0.15", 0, 0.3, 0))), RunConfig())
    assert not report.has_headroom and not any("enlarged" in line for line in report.lines())
    high = report.grid_high[1]
    grown = check_scene(load_edit_scene(make_scene(region=ball("0.15", 0, high - 0.15 * 0.92, 0))), RunConfig())
    assert grown.has_headroom and grown.regions[0].share_in_grid == 1 and grown.grid_high[1] > high
    assert any("enlarged to hold the regions" in line for line in grown.lines())
    held = check_scene(load_edit_scene(make_scene(region=ball("0.15", 0, high - 0.15 * 1.01, 0))), RunConfig())
    assert not held.has_headroom and held.grid_high[1] == high


def test_report_as_json_and_lines(make_scene: Make, animal: tuple[np.ndarray, np.ndarray]) -> None:
    report = check_scene(load_edit_scene(make_scene()), RunConfig())
    data = json.loads(json.dumps(report.to_json()))
    assert data["base"][0]["topology"]["closed"] is True and data["regions"][0]["name"] == "wing"
    assert data["cost"]["seconds_total"] > 0
    # A cube in the scene's units, 7/6 of the longest side of the base, around the base's centre.
    low, high = np.array(data["grid_low"]), np.array(data["grid_high"])
    assert high - low == pytest.approx([report.longest_side * 7 / 6] * 3, rel=1e-5)
    assert any(f"grid x {low[0]:.4g} to {high[0]:.4g}" in line for line in report.lines())
    base = animal[0].min(axis=0), animal[0].max(axis=0)
    assert np.array([data["base_low"], data["base_high"]]) == pytest.approx(np.stack(base), abs=1e-5)
    assert any(f"base x {base[0][0]:.4g} to {base[1][0]:.4g}" in line for line in report.lines())
    assert all(isinstance(line, str) and "\n" not in line for line in report.lines())


def test_open_base_and_doubled_faces_are_told(
    make_scene: Make, tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]
) -> None:
    path = make_scene()
    vertices, faces = animal
    write_ply(tmp_path / "animal.ply", vertices, faces[5:])
    assert "not closed" in warnings(path)
    write_ply(tmp_path / "animal.ply", vertices, np.concatenate([faces, faces[:3]]))
    assert "3 faces are there twice" in warnings(path)
    write_ply(tmp_path / "animal.ply", vertices, faces[:, ::-1])
    assert "point inwards" in warnings(path)


@pytest.mark.parametrize(
    ("region", "words"),
    [
        (ball("0.03", 0, 0.3, 0), "cells thin"),
        (ball("0.1", 0, 0.45, 0), "gap"),
        (ball("0.1", 0, 0.175, 0), "inside the base"),
    ],
)
def test_regions_are_judged(make_scene: Make, region: str, words: str) -> None:
    assert words in warnings(make_scene(region=region))


def test_thin_region_names_a_resolution_that_is_enough(make_scene: Make) -> None:
    path = make_scene(region=ball("0.022", 0, 0.25, 0))
    words = warnings(path)
    resolution = int(words.split("grid_resolution=")[1].split()[0])
    assert "cells thin" not in warnings(path, RunConfig(geometry=GeometryConfig(grid_resolution=resolution)))


def test_scene_level_warnings(make_scene: Make) -> None:
    text = warnings(
        make_scene(
            light="", integrator='<integrator type="dual_path"><string name="prompt" value="a pig"/></integrator>'
        )
    )
    assert "no emitter" in text and "base_prompt" in text


def _with_prompt(prompt: str) -> str:
    return f'<integrator type="dual_path"><string name="prompt" value="{prompt}"/></integrator>'


def test_the_prompt_is_read_as_a_run_reads_it(make_scene: Make) -> None:
    scene = load_edit_scene(make_scene(integrator=_with_prompt("a cuddly rabbit with a wizard's hat")))
    report = check_scene(scene, RunConfig())
    assert "read as  part: pointed hat; body: rabbit; ignored: cuddly" in report.lines() and report.refusal is None
    assert json.loads(json.dumps(report.to_json()))["prompt_reading"]["caption"] == "a rabbit with a wizard hat"
    heard: list[str] = []
    prepare_geometry(scene, RunConfig(), heard.append)
    assert heard == ["prompt read as part: pointed hat; body: rabbit; ignored: cuddly"]
    for settings in (["geometry.lambda_sds=0", "appearance.lambda_sds=0"], ["guidance.model=owner/stable-diffusion"]):
        assert check_scene(scene, RunConfig.load(None, settings)).prompt_reading is None


@pytest.mark.parametrize("prompt", ["a pig", "a pig without wings", "a pig with a jetpack", "a pig with a tie"])
def test_a_prompt_that_a_run_refuses_is_refused(
    make_scene: Make, prompt: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_scene(integrator=_with_prompt(prompt))
    with pytest.raises(UserError) as refused:
        prepare_geometry(load_edit_scene(path), RunConfig(), lambda line: None)
    assert main(["check", str(path)]) == 1
    told = capsys.readouterr()
    assert (
        told.err == f"fd_mitsuba: error: {refused.value}\n" and "cost" in told.out and "nothing to warn" not in told.out
    )
    assert ("subtract" in told.err) == ("without" in prompt)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (["guidance.model=no-such-folder"], "no-such-folder: no such folder"),
        (["guidance.lora=a.safetensors"], "made for Stable Diffusion"),
        (["guidance.model=a/b", "guidance.lora=a.safetensors"], "a.safetensors: no such file or folder"),
        (["guidance.model=a/b", "guidance.image_prompt=a.png"], "guidance.ip_adapter: is missing"),
        (["guidance.model=a/b", "guidance.variant=vsd", "guidance.dtype=float16"], "too small for float16"),
        (["guidance.model=a/b", "guidance.variant=csd", "guidance.perp_neg=1"], "csd makes no use of it"),
    ],
)
def test_a_model_that_a_run_refuses_is_refused(make_scene: Make, settings: list[str], expected: str) -> None:
    scene = load_edit_scene(make_scene(integrator=_with_prompt("a rabbit with a hat")))
    refusal = check_scene(scene, RunConfig.load(None, settings)).refusal
    assert refusal is not None and expected in refusal and "\n" not in refusal
    unused = [*settings, "geometry.lambda_sds=0", "appearance.lambda_sds=0"]
    assert check_scene(scene, RunConfig.load(None, unused)).refusal is None


def test_a_cut_that_a_run_refuses_is_refused(make_scene: Make) -> None:
    cut = ball("0.15", 0, 0.3, 0).replace("<transform", '<string name="mode" value="subtract"/><transform')
    scene = load_edit_scene(make_scene(region=cut))
    assert "subtract" in (check_scene(scene, RunConfig()).refusal or "")
    assert check_scene(scene, RunConfig.load(None, ["geometry.lambda_sds=0"])).refusal is None
    assert "what to take off" in (check_scene(scene, RunConfig()).refusal or "")
    scene = load_edit_scene(make_scene(region=cut, integrator=_with_prompt("a pig without its ears")))
    report = check_scene(scene, RunConfig())
    assert report.refusal is None and "read as  taken off: ears; body: pig" in report.lines()


def test_a_material_that_cannot_be_learned_is_told(make_scene: Make) -> None:
    text = warnings(make_scene(part='<bsdf type="dielectric" id="part"/>'))
    assert "--stage geometry" in text and "nothing to learn (a dielectric" in text
    rough = '<bsdf type="principled"><float name="roughness" value="7"/></bsdf>'
    text = warnings(make_scene(base=BASE.replace('<bsdf type="diffuse"/>', rough)))
    assert "--stage geometry" in text and "roughness is 7" in text


def test_cost_follows_what_it_depends_on(make_scene: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fd_mitsuba.runs.cost.processor_speed", lambda: 104e9)
    scene = load_edit_scene(make_scene())
    default = estimate_cost(scene, RunConfig())
    fine = estimate_cost(scene, RunConfig(geometry=GeometryConfig(grid_resolution=128)))
    short = estimate_cost(scene, RunConfig(geometry=GeometryConfig(steps=300)))
    large = estimate_cost(scene, RunConfig(guidance=GuidanceConfig(model="somebody/stable-diffusion")))
    assert fine.active_vertices == pytest.approx(8 * default.active_vertices, rel=0.1)
    assert fine.seconds_per_step > default.seconds_per_step
    fixed = START_AND_EXPORT_SECONDS
    assert short.seconds_total - fixed == pytest.approx((default.seconds_total - fixed) / 10, rel=1e-3)
    without = estimate_cost(scene, RunConfig(geometry=GeometryConfig(lambda_sds=0)))
    assert without.seconds_per_step < 0.1 and without.geometry_memory_mb < default.geometry_memory_mb
    assert large.seconds_per_step > 10 * default.seconds_per_step and large.memory_mb > default.memory_mb + 3000


@pytest.mark.parametrize(
    ("more", "seconds", "megabytes"),
    [
        (["geometry.coarse_fraction=1.0"], 0.125, 1163),
        (["geometry.coarse_fraction=1.0", "geometry.grid_resolution=128"], 0.178, 1526),
        (["geometry.coarse_fraction=0.0"], 0.297, 1212),
    ],
)
def test_cost_of_runs_that_were_measured(
    monkeypatch: pytest.MonkeyPatch, more: list[str], seconds: float, megabytes: float
) -> None:
    monkeypatch.setattr("fd_mitsuba.runs.cost.cores_in_use", lambda: 2)  # as they were measured
    monkeypatch.setattr("fd_mitsuba.runs.cost.processor_speed", lambda: 104e9)
    scene = load_edit_scene(ROOT / "scenes" / "pegasus" / "scene.xml")
    undrafted = [*more, "geometry.draft_fraction=0"]
    cost = estimate_cost(scene, RunConfig.load(ROOT / "configs" / "quick.toml", undrafted))
    assert cost.seconds_per_step == pytest.approx(seconds, rel=0.2)
    assert cost.geometry_memory_mb == pytest.approx(megabytes, rel=0.15)


def test_drafted_steps_cost_no_passes_and_the_pictures_are_drawn_once(
    make_scene: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By counting: 4 views see the network twice in a step, and those of the picture 2 * 6 times in a run."""
    monkeypatch.setattr("fd_mitsuba.runs.cost.processor_speed", lambda: 104e9)
    scene = load_edit_scene(make_scene())

    def seconds(*more: str) -> float:
        return estimate_cost(scene, RunConfig.load("quick", more)).seconds_total

    plain, some, more = (seconds(f"geometry.draft_fraction={share}") for share in (0, 0.4, 0.8))
    passes = (some - more) / (0.4 * 400 * 4 * 2)
    assert plain - some == pytest.approx(passes * (0.4 * 400 * 4 * 2 - 4 * 2 * 6), rel=1e-6)


def test_cost_of_the_appearance_stage(make_scene: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fd_mitsuba.runs.cost.cores_in_use", lambda: 2)  # as they were measured
    monkeypatch.setattr("fd_mitsuba.runs.cost.processor_speed", lambda: 104e9)
    scene = load_edit_scene(make_scene())
    quick = estimate_cost(scene, RunConfig.load(ROOT / "configs" / "quick.toml", []))
    assert quick.appearance_seconds_per_step == pytest.approx(0.095, rel=0.2)
    # `benchmarks/appearance_step.py`: 4 views of 128 x 128 pixels, 16 samples, no network.
    chosen = ["appearance.lambda_sds=0", "output.texture_size=512", "output.picture_size=0"]
    plain = estimate_cost(scene, RunConfig.load(None, [*chosen, "appearance.picture_size=128"]))
    assert plain.appearance_seconds_per_step == pytest.approx(0.188, rel=0.2)
    short = estimate_cost(scene, RunConfig.load(None, [*chosen, "appearance.steps=200"]))
    steps = [cost.appearance_seconds_total - LIT_PICTURES_SECONDS for cost in (short, plain)]
    assert steps[0] == pytest.approx(steps[1] / 10, rel=1e-3)
    pictured = estimate_cost(
        scene, RunConfig.load(None, [*chosen[:2], "appearance.steps=200", "output.picture_size=768"])
    )
    seconds = pictured.appearance_seconds_total - short.appearance_seconds_total
    assert seconds == pytest.approx(PHOTOGRAPHS_SECONDS)
    # Runs of the cat with quick settings: 161 s with baked textures of 4096 x 4096, 88 s with those of 512 x 512.
    baked = estimate_cost(scene, RunConfig.load(None, [*chosen, "appearance.steps=200", "output.texture_size=4096"]))
    assert baked.appearance_seconds_total - short.appearance_seconds_total == pytest.approx(161 - 88, rel=0.25)
    deep = estimate_cost(scene, RunConfig.load(None, [*chosen, "appearance.max_depth=6"]))
    assert deep.appearance_seconds_per_step > 2 * plain.appearance_seconds_per_step
    lines = check_scene(scene, RunConfig()).lines()
    assert sum("s a step" in line for line in lines) == 2
    cut = ball("0.15", 0, 0.3, 0).replace("<transform", '<string name="mode" value="subtract"/><transform')
    left_out = estimate_cost(load_edit_scene(make_scene(region=cut)), RunConfig())
    assert left_out.appearance_seconds_total == 0


@pytest.mark.parametrize(
    ("device", "dtype", "found", "said"),
    [
        ("cpu", "float32", {"float32": 2e10}, "networks on cpu at 0.02 TFLOP/s in float32, as measured just now"),
        (
            "cuda",
            "float16",
            {"float32": 2e13, "float16": 1e14},
            "networks on cuda at 100 TFLOP/s in float16 and 20 TFLOP/s in float32, as measured just now",
        ),
        (
            "cuda",
            "float16",
            {},
            "60 TFLOP/s in float16 and 30 TFLOP/s in float32, as of a usual card: torch finds no cuda",
        ),
    ],
)
def test_cost_of_a_real_model_follows_the_speed_of_its_device(
    make_scene: Make, monkeypatch: pytest.MonkeyPatch, device: str, dtype: str, found: dict[str, float], said: str
) -> None:
    """0.7e12 operations a view and pass, 2.2e12 for a picture to the latents and back, four views and two passes."""
    monkeypatch.setattr("fd_mitsuba.guidance.speed.measured_speed", lambda _, kind: found.get(kind))
    chosen = [f"guidance.device={device}", f"guidance.dtype={dtype}", "guidance.model=somebody/model"]
    scene = load_edit_scene(make_scene())
    with_it, without = (
        estimate_cost(scene, RunConfig.load(None, [*chosen, "geometry.coarse_fraction=0", *more]))
        for more in ([], ["geometry.lambda_sds=0"])
    )
    unet, vae = (found or {"float16": 6e13, "float32": 3e13}).get(dtype), (found or {"float32": 3e13})["float32"]
    networks = 4 * (2 * 800 * 860e6 / unet + 2.2e12 / vae)
    rendering = with_it.seconds_per_step - without.seconds_per_step - networks
    assert 0 <= rendering < 4
    assert any(said in assumption for assumption in with_it.assumptions)


def test_cost_counts_the_passes_that_prompts_add(make_scene: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """2 passes a view; Perp-Neg one more, a part's own prompt another, and its own negative prompt one more again."""
    monkeypatch.setattr("fd_mitsuba.guidance.speed.measured_speed", lambda *_: 688e6)  # a pass is then 1000 s
    prompt, negative = '<string name="prompt" value="a hat"/>', '<string name="negative_prompt" value="a cap"/>'

    def a_view(inner: str, *more: str) -> float:
        region = ball("0.15", 0, 0.35, 0).replace("<transform", f"{inner}<transform")
        chosen = ["guidance.model=a/b", "geometry.views=1", "geometry.coarse_fraction=1", *more]
        return estimate_cost(load_edit_scene(make_scene(region=region)), RunConfig.load(None, chosen)).seconds_per_step

    seconds = [a_view(""), a_view("", "guidance.perp_neg=1"), a_view(prompt), a_view(prompt + negative)]
    assert [round(value / 1000) for value in seconds] == [2, 3, 3, 4]
    assert round(a_view(prompt + negative, "guidance.guidance_scale=1") / 1000) == 2


def test_the_built_in_prior_is_not_measured(make_scene: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that `check` of a shipped scene takes no longer."""
    monkeypatch.setattr("fd_mitsuba.guidance.speed.measured_speed", lambda *_: pytest.fail("measured all the same"))
    scene = load_edit_scene(make_scene())
    estimate_cost(scene, RunConfig())
    estimate_cost(
        scene, RunConfig.load(None, ["guidance.model=a/b", "geometry.lambda_sds=0", "appearance.lambda_sds=0"])
    )


def test_the_speed_of_a_device() -> None:
    assert 1e8 < measured_speed("cpu", "float32", 0.0) < 1e15
    assert measured_speed("cuda:99", "float16", 0.0) is None
    with pytest.raises(ValueError, match="float64"):
        measured_speed("cpu", "float64")


def test_memory_of_stable_diffusion_is_what_loading_it_demands(make_scene: Make) -> None:
    config = RunConfig.load(ROOT / "configs" / "paper.toml")
    cost = estimate_cost(load_edit_scene(make_scene()), config)
    unet = {"block_out_channels": [320, 640, 1280, 1280]}
    vae = {"block_out_channels": [128, 256, 512, 512], "layers_per_block": 2}
    demanded = 4 * (860e6 + 123e6 + 84e6) + working_set_bytes(unet, vae, 64, 4, "float32")
    assert 1 <= cost.memory_mb / (demanded / 1e6) < 1.2


def test_what_latents_of_half_the_side_take(make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the network's seconds and of what it works in: pictures of 256 pixels instead of 512."""
    scene, costs = load_edit_scene(make_scene()), []
    monkeypatch.setattr("fd_mitsuba.guidance.speed.measured_speed", lambda *_: 1e11)
    config = RunConfig.load(ROOT / "configs" / "paper.toml", [f"guidance.model={tmp_path}"])
    (tmp_path / "unet").mkdir()
    for entry in ("sample_size", "image_size"):
        for side in (32, 64):
            (tmp_path / "unet" / "config.json").write_text(json.dumps({entry: side}))
            costs.append(estimate_cost(scene, config))
    assert costs[:2] == costs[2:]
    assert costs[0].seconds_per_step == pytest.approx(costs[1].seconds_per_step / 4, rel=0.2)
    unet = {"block_out_channels": [320, 640, 1280, 1280]}
    vae = {"block_out_channels": [128, 256, 512, 512], "layers_per_block": 2}
    less = working_set_bytes(unet, vae, 64, 4, "float32") - working_set_bytes(unet, vae, 32, 4, "float32")
    assert (costs[1].geometry_memory_mb - costs[0].geometry_memory_mb) * 2**20 == pytest.approx(less, rel=0.05)


def view_in(path: Path) -> np.ndarray:
    """(size, size, 3) the first view of a preview in [0, 1], where the file says that it is."""
    with Image.open(path) as image:
        view = json.loads(image.info["fd_mitsuba"])["views"][0]
        picture = np.asarray(image.convert("RGB")).astype(float) / 255
    return picture[view["top"] : view["top"] + view["size"], view["left"] : view["left"] + view["size"]]


def test_preview_shows_base_and_region(make_scene: Make, tmp_path: Path) -> None:
    base = BASE.replace('<bsdf type="diffuse"/>', '<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf>')
    scene = load_edit_scene(make_scene(base=base, region=ball("0.15", 0, 0.35, 0)))
    (path,) = preview_scene(scene, tmp_path / "out", ["front"], size=96)
    tile = view_in(path)
    saturation = tile.max(axis=-1) - tile.min(axis=-1)
    orange = (saturation > 0.12) & (tile[..., 0] > tile[..., 2])
    grey = (saturation < 0.05) & (tile[..., 0] < 0.9)
    assert orange.sum() > 80 and grey.sum() > 300
    rows_of = lambda mask: np.nonzero(mask)[0].mean()  # noqa: E731
    assert rows_of(orange) < rows_of(grey)  # the region is above the body


def test_preview_is_not_grainy(make_scene: Make, tmp_path: Path) -> None:
    base = BASE.replace('<bsdf type="diffuse"/>', '<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf>')
    light = """<emitter type="constant"/><emitter type="point"><point name="position" x="1" y="2" z="2"/></emitter>"""
    scene = load_edit_scene(make_scene(base=base, light=light, region=ball("0.05", 0, 0.35, 0)))
    (path,) = preview_scene(scene, tmp_path / "out", ["front"], size=128)
    body = view_in(path)[50:75, 50:78, 2]
    # What an average over the neighbours takes away is grain: the body itself is smooth but for a few edges.
    around = sum(np.roll(body, shift, axis) for shift in (-1, 1) for axis in (0, 1)) / 4
    assert np.median(np.abs(body - around)[1:-1, 1:-1]) < 0.008


def test_preview_without_light_and_into_a_file(make_scene: Make, tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene(light=""))
    (path,) = preview_scene(scene, tmp_path / "out", ["front"], size=32)
    assert np.asarray(Image.open(path)).std() > 5
    (tmp_path / "taken").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        preview_scene(scene, tmp_path / "taken", ["front"], size=16)


def test_colours_differ() -> None:
    colours = np.array(region_colours(6))
    gaps = np.linalg.norm(colours[:, None] - colours[None], axis=-1)[~np.eye(6, dtype=bool)]
    assert gaps.min() > 0.2
