"""The appearance pass against stock Mitsuba, closed forms and its own promises."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import torch
from appearance_setup import (
    AREA,
    CONSTANT,
    WHITE,
    AppearancePass,
    PartShading,
    ball,
    blocks,
    camera,
    constants,
    render,
    shading,
    stock,
    write_sky,
)  # fmt: skip

from fd_mitsuba.config.sections import TextureConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.scene_file import ready_mitsuba
from fd_mitsuba.scene.views import ring_views

GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(CONSTANT["base_color"])}}


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> EditScene:
    folder = tmp_path_factory.mktemp("sky")
    return blocks(folder, write_sky(folder))


@pytest.fixture(scope="module")
def lamp(tmp_path_factory: pytest.TempPathFactory) -> EditScene:
    return blocks(tmp_path_factory.mktemp("lamp"), AREA)


def plain(plugin: str) -> dict:
    """The constants as stock Mitsuba gets them."""
    colour = {"type": "rgb", "value": list(CONSTANT["base_color"])}
    (rough,), (metal,) = CONSTANT["roughness"], CONSTANT["metallic"]
    return {
        "principled": {"base_color": colour, "roughness": rough, "metallic": metal},
        "roughplastic": {"diffuse_reflectance": colour, "alpha": 0.3},
        "roughconductor": {"specular_reflectance": colour, "alpha": rough},
        "diffuse": {"reflectance": colour},
    }[plugin] | {"type": plugin}  # fmt: skip


def assert_as_stock(scene: EditScene, plugin: str, max_depth: int = 2, size: int = 24, spp: int = 1024) -> None:
    """Same mean radiance of part and base, and the same coverage, as Mitsuba's `path` gives."""
    fixed = {"alpha": 0.3} if plugin == "roughplastic" else {}
    appearance = AppearancePass(scene, {"part": ball()}, shading(plugin, **fixed), size, spp, max_depth)
    if max_depth != 2:
        values = {name: np.tile(CONSTANT[name], (len(ball().vertices), 1)) for name in shading(plugin).feeds}
        appearance.set_vertex_values("part", values)
    pictures = render(appearance, camera(), plugin)
    merged, mask = pictures.merged[0].permute(1, 2, 0).numpy(), pictures.part_mask[0, 0].numpy()
    expected, alpha = stock(scene, ball(), plain(plugin), camera(), size, spp, max_depth)
    assert np.abs(pictures.alpha[0, 0].numpy() - alpha).max() < 0.05
    for where in (mask == 1, mask == 0):
        assert merged[where].sum() == pytest.approx(expected[where].sum(), rel=5e-3)


@pytest.mark.parametrize("plugin", [pytest.param("principled", marks=pytest.mark.slow), "roughplastic", "diffuse"])
def test_constant_fields_are_stock_mitsuba_under_a_sky(sky: EditScene, plugin: str) -> None:
    assert_as_stock(sky, plugin)


@pytest.mark.parametrize("plugin", ["principled", pytest.param("roughconductor", marks=pytest.mark.slow)])
def test_constant_fields_are_stock_mitsuba_under_an_area_light(lamp: EditScene, plugin: str) -> None:
    assert_as_stock(lamp, plugin)


@pytest.mark.parametrize("depth", [3, pytest.param(-1, marks=pytest.mark.slow)])
def test_bounces_are_those_of_stock_mitsuba(lamp: EditScene, depth: int) -> None:
    assert_as_stock(lamp, "diffuse", depth)


def test_limited_bounces_lie_between_direct_light_and_all_of_it(lamp: EditScene) -> None:
    direct, bounced = (AppearancePass(lamp, {"part": ball()}, shading("diffuse"), 16, 32, depth) for depth in (2, 3))
    least, most = (render(rendering, camera(), "diffuse").merged for rendering in (direct, bounced))
    found = {}
    for limit in (0.0, 0.2, 1e9):
        bounced.limit_bounces(limit)
        found[limit] = render(bounced, camera(), "diffuse").merged
    assert torch.allclose(found[0.0], least, atol=1e-6) and torch.equal(found[1e9], most)
    between = found[0.2]
    assert (between <= most + 1e-6).all() and (between >= least - 1e-6).all()
    assert float(least.sum()) < 0.99 * float(between.sum()) < 0.99 * float(most.sum())


def test_the_light_behind_the_object_is_what_stock_mitsuba_shows(sky: EditScene, lamp: EditScene) -> None:
    high = camera(elevation=-20.0, fov=60.0)
    appearance = AppearancePass(sky, {"part": ball()}, shading("diffuse"), 24, 256)
    gbuffer = appearance.trace(high, 3)
    behind = appearance.render_light(gbuffer)[0].permute(1, 2, 0).numpy()
    expected, _ = stock(sky, ball(), GREY, high, 24, 256, hide_emitters=False)
    empty = gbuffer.alpha[0, 0].numpy() == 0
    assert empty.mean() > 0.3 and expected[empty].std() > 0.05
    assert np.abs(behind[empty] - expected[empty]).mean() < 0.01 * expected[empty].mean()
    lit_by_lamp = AppearancePass(lamp, {"part": ball()}, shading("diffuse"), 8, 2)
    assert not lit_by_lamp.render_light(lit_by_lamp.trace(high, 3)).any()


def test_a_white_part_in_a_white_furnace_gains_no_energy(tmp_path: Path) -> None:
    """Alone in light of radiance 1 from everywhere, no BSDF should send back more than 1.

    A white dielectric `principled` does by itself, as its specular lobe comes on top of the diffuse one: nothing may be
    added to what stock Mitsuba says, and the lightest base colour that the field can have must stay below 1.
    """
    scene = blocks(tmp_path, WHITE)
    far, size, view = ball(height=60.0), 16, camera(height=60.0, fov=14.0)

    def mean(plugin: str, colour: float, rough: float, metal: float) -> float:
        appearance = passes.setdefault(plugin, AppearancePass(scene, {"part": far}, shading(plugin), size, spp=256))
        values = {"base_color": (colour,) * 3, "roughness": (rough,), "metallic": (metal,)}
        pictures = render(appearance, view, plugin, **values)
        return float(pictures.merged[(pictures.part_mask == 1).expand_as(pictures.merged)].mean())

    passes: dict[str, AppearancePass] = {}
    ranges = TextureConfig()
    lightest, smoothest = ranges.base_color_range[1], ranges.roughness_range[0]
    assert 0.99 < mean("diffuse", 1.0, 0.0, 0.0) < 1.005
    for rough in (smoothest, 0.3, 0.6, 1.0):
        assert 0.6 < mean("roughconductor", 1.0, rough, 0.0) < 1.005
        assert 0.3 < mean("principled", 1.0, rough, 1.0) < 1.005
        assert 0.6 < mean("principled", lightest, rough, 0.0) < 1.0
        assert 0.6 < mean("principled", lightest, rough, 0.5) < 1.0
    for colour, rough, metal in ((1.0, 0.2, 0.0), (1.0, 1.0, 0.0), (lightest, smoothest, 0.0), (0.97, 0.4, 0.3)):
        white = {"type": "principled", "base_color": {"type": "rgb", "value": colour}}
        expected, alpha = stock(scene, far, white | {"roughness": rough, "metallic": metal}, view, size, 1024)
        assert mean("principled", colour, rough, metal) == pytest.approx(expected[alpha == 1].mean(), rel=5e-3)


def test_bent_normals_gain_no_energy_and_leave_no_black_pixel(tmp_path: Path) -> None:
    scene = blocks(tmp_path, WHITE)
    appearance = AppearancePass(scene, {"part": ball(height=60.0)}, shading("principled"), size=32, spp=32)
    gbuffer = appearance.trace(camera(height=60.0, fov=14.0), seed=1)
    fields = constants(gbuffer, "principled", CONSTANT)
    slope = torch.randn(len(gbuffer.points), 2, generator=torch.Generator().manual_seed(1))
    fields["normal"] = torch.cat([slope, torch.full((len(slope), 1), 0.3)], dim=1)
    pictures = appearance.render(gbuffer, **fields, seed=1)
    inner = pictures.merged[(pictures.part_mask == 1).expand_as(pictures.merged)]
    assert 0.02 < float(inner.min()) and float(inner.mean()) < 1.0


def test_a_part_above_the_base_darkens_it_as_in_stock_mitsuba(lamp: EditScene) -> None:
    view, size, spp = camera(azimuth=220.0, elevation=40.0, fov=40.0, height=0.2), 24, 1024
    with_part = render(AppearancePass(lamp, {"part": ball()}, shading("diffuse"), size, spp), view, "diffuse")
    alone = AppearancePass(lamp, {}, shading("diffuse"), size, spp)
    without = alone.render_base(alone.trace(view, 3), 3)[0].mean(dim=0).numpy()
    base = with_part.base_path[0].mean(dim=0).numpy()
    only_base = (with_part.part_mask[0, 0] == 0).numpy() & (with_part.alpha[0, 0] == 1).numpy()
    expected, _ = stock(lamp, ball(), GREY, view, size, spp)
    shadow = only_base & (expected.mean(axis=-1) < 0.5 * without)
    assert shadow.sum() > 10
    assert base[shadow].sum() == pytest.approx(expected.mean(axis=-1)[shadow].sum(), rel=0.03)
    assert base[shadow].mean() < 0.3 * without[shadow].mean()


def test_base_pixels_out_of_the_parts_reach_are_those_of_the_base_alone(lamp: EditScene) -> None:
    view = camera(elevation=40.0, fov=40.0, height=0.2)
    with_part = AppearancePass(lamp, {"part": ball()}, shading("principled"), 32, 16)
    alone = AppearancePass(lamp, {}, shading("principled"), 32, 16)
    merged = render(with_part, view, "principled", seed=7)
    gbuffer = alone.trace(view, 7)
    expected = alone.render_base(gbuffer, 7)
    same = (merged.part_mask == 0) & (gbuffer.alpha > 0)
    lit_alike = same & ((merged.base_path - expected).abs().amax(dim=1, keepdim=True) == 0)
    assert lit_alike.sum() > 0.5 * same.sum()  # under this lamp, all that lies outside the shadow
    assert (merged.base_path <= expected + 1e-6)[same.expand_as(expected)].all()
    assert torch.equal(alone.render_base(gbuffer, 7), expected)


def test_masks_add_up_and_paths_too(sky: EditScene) -> None:
    appearance = AppearancePass(sky, {"part": ball()}, shading("diffuse"), 32, 16)
    gbuffer = appearance.trace(camera(fov=60.0), seed=5)
    pictures = appearance.render(gbuffer, **constants(gbuffer, "diffuse", CONSTANT), seed=5)
    assert torch.equal(gbuffer.alpha, gbuffer.base_mask + gbuffer.part_mask)
    assert torch.equal(pictures.merged, pictures.part_path + pictures.base_path)
    assert 0 < float(gbuffer.part_mask.sum()) < float(gbuffer.alpha.sum()) < gbuffer.alpha.numel()
    assert not pictures.merged[(gbuffer.alpha == 0).expand_as(pictures.merged)].any()
    assert not pictures.part_path[(gbuffer.part_mask == 0).expand_as(pictures.merged)].any()
    assert not pictures.base_path[(gbuffer.base_mask == 0).expand_as(pictures.merged)].any()


def test_points_lie_on_the_part_in_the_canonical_frame(sky: EditScene) -> None:
    small = ball(0.7, 0.2)
    second = type(small)("second", small.vertices + (0.6, 0.0, 0.0), small.faces)
    appearance = AppearancePass(sky, {"first": small, "second": second}, shading("diffuse"), 32, 8)
    gbuffer = appearance.trace(ring_views(3), seed=5)
    centre = torch.tensor([0.0, 0.7, 0.0]) + gbuffer.part[:, None] * torch.tensor([0.6, 0.0, 0.0])
    assert set(gbuffer.part.tolist()) == {0, 1} and set(gbuffer.view.tolist()) == {0, 1, 2}
    away = gbuffer.points - centre
    assert (away.norm(dim=1) - 0.2).abs().max() < 0.005
    assert ((away / away.norm(dim=1, keepdim=True)) * gbuffer.normals).sum(dim=1).min() > 0.99
    seen = torch.zeros(gbuffer.part_mask.numel())
    seen[gbuffer.pixel] = 1.0
    assert torch.equal(seen > 0, gbuffer.part_mask.flatten() > 0)
    assert torch.equal(gbuffer.pixel, gbuffer.pixel.sort().values)


def test_with_one_path_the_field_shades_the_base_too(sky: EditScene) -> None:
    appearance = AppearancePass(sky, {"part": ball()}, shading("diffuse"), 16, 8, deferred_base=True)
    gbuffer = appearance.trace(camera(fov=60.0), seed=5)
    colour = torch.zeros(len(gbuffer.points), 3)
    pictures = appearance.render(gbuffer, colour, None, None, None, seed=5)
    assert not pictures.merged.any()
    assert len(colour) == int((gbuffer.alpha > 0).sum()) > int((gbuffer.part_mask > 0).sum()) > 0


def test_no_kernel_is_compiled_when_other_pixels_see_the_part(sky: EditScene) -> None:
    import drjit as dr

    appearance = AppearancePass(sky, {"part": ball()}, shading("diffuse"), 16, 4)

    def step(number: int) -> int:
        gbuffer = appearance.trace(camera(azimuth=37.0 * number, fov=30.0 + number), seed=number)
        colour = torch.full((len(gbuffer.points), 3), 0.5, requires_grad=True)
        appearance.render(gbuffer, colour, None, None, None, seed=number).merged.sum().backward()
        return len(gbuffer.points)

    step(0), step(1)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        counts = {step(number) for number in range(2, 7)}
        compiled = [entry for entry in dr.kernel_history() if "cache_hit" in entry and not entry["cache_hit"]]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert len(counts) > 2 and not compiled


def test_equal_seeds_give_equal_pictures(sky: EditScene) -> None:
    appearance = AppearancePass(sky, {"part": ball()}, shading("diffuse"), 16, 4)
    first, again, other = (render(appearance, camera(), "diffuse", seed=seed).merged for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_values_must_fit_the_points_and_the_bsdf(sky: EditScene) -> None:
    appearance = AppearancePass(sky, {"part": ball()}, shading("diffuse"), 16, 4)
    gbuffer = appearance.trace(camera(), seed=1)
    with pytest.raises(ValueError, match="base_color: missing"):
        appearance.render(gbuffer, None, None, None, None, seed=1)
    with pytest.raises(ValueError, match="base_color: \\(3, 3\\)"):
        appearance.render(gbuffer, torch.zeros(3, 3), None, None, None, seed=1)
    with pytest.raises(ValueError, match="normal"):
        PartShading({"type": "diffuse"}, {"normal": "reflectance"})
    with pytest.raises(ValueError, match="max_depth = 1"):
        AppearancePass(sky, {}, shading("diffuse"), max_depth=1)
    broken = ball()
    with pytest.raises(ValueError, match="part 'x'"):
        AppearancePass(sky, {"x": type(broken)("x", broken.vertices[:5], broken.faces)}, shading("diffuse"))


def test_a_scene_without_light_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"scene\.xml: no emitter"):
        AppearancePass(blocks(tmp_path, ""), {}, shading("diffuse"))


def test_a_part_leaves_the_lights_where_they_are(sky: EditScene) -> None:
    """Not a digit of a ray to a light may depend on the part: the base's own shadows would flicker at their edges."""
    mi = ready_mitsuba()
    targets = []
    for parts in ({}, {"part": ball(0.6, 0.4)}):
        lit = AppearancePass(sky, parts, shading("diffuse")).scene.lit
        surface = dr.zeros(mi.SurfaceInteraction3f, 64)
        surface.p = mi.Point3f(0.4, 1.3, -0.3)
        sampler = mi.PCG32(64)
        numbers = mi.Point2f(sampler.next_float32(), sampler.next_float32())
        targets.append(np.array(lit.sample_emitter_direction(surface, numbers, False)[0].p))
    assert len(np.unique(targets[0], axis=1).T) > 10 and np.array_equal(*targets)
