"""Gradients of the appearance pass against central finite differences with common random numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr  # noqa: E402  (after `appearance_setup`, which chooses the LLVM)
import numpy as np
import pytest
import torch
from appearance_setup import (
    AREA,
    CONSTANT,
    AppearancePass,
    EditScene,
    GBuffer,
    PartShading,
    ball,
    blocks,
    camera,
    mi,
    shading,
    write_sky,
)

from fd_mitsuba.config.sections import TextureConfig
from fd_mitsuba.fields.texture import TextureField

SIZE = 8
STEP = {"base_color": 0.02, "roughness": 0.005, "metallic": 0.02, "normal": 0.005}
WIDE, NARROW = 0.03, 0.01
Fields = dict[str, torch.Tensor]


@pytest.fixture(scope="module", params=["sky", "area light"])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> EditScene:
    folder = tmp_path_factory.mktemp("scene")
    return blocks(folder, write_sky(folder) if request.param == "sky" else AREA)


def fields(gbuffer: GBuffer, tilt: float = 0.25) -> Fields:
    """Another material at every pixel, with bent normals."""
    generator = torch.Generator().manual_seed(4)
    count = len(gbuffer.points)
    values = {
        name: torch.tensor([value]) + 0.2 * (torch.rand(count, len(value), generator=generator) - 0.5)
        for name, value in CONSTANT.items()
    }
    slope = tilt * (2 * torch.rand(count, 2, generator=generator) - 1)
    values["normal"] = torch.nn.functional.normalize(torch.cat([slope, torch.ones(count, 1)], dim=1), dim=1)
    return values


def pixel_losses(appearance: AppearancePass, gbuffer: GBuffer, values: Fields, seed: int = 2) -> torch.Tensor:
    """(N,) one weighted sum of colours for each pixel that sees the part: no value reaches any other pixel."""
    merged = appearance.render(gbuffer, **values, seed=seed).merged
    weights = torch.tensor([0.9, -0.5, 0.7])
    return (merged.movedim(1, -1).reshape(-1, 3) @ weights)[gbuffer.pixel]


class SameLight:
    """Light samples of the part as they were at the first call: common random numbers in the strict sense.

    Directions that follow the material would make a difference quotient at one pixel useless: a sampled direction that
    moves on to a small bright light or off it changes the pixel by a jump.
    """

    def __init__(self, appearance: AppearancePass) -> None:
        self._transport, self._bsdf, self._light = appearance._transport, appearance._shading.bsdf, None

    def incident(self, surface: Any, bsdf: Any, *rest: Any) -> Any:
        if bsdf is not self._bsdf:
            return self._transport.incident(surface, bsdf, *rest)
        if self._light is None:
            self._light = self._transport.incident(surface, bsdf, *rest)
            dr.eval(self._light)
        return self._light


def test_single_pixels_match_finite_differences(scene: EditScene) -> None:
    appearance = AppearancePass(scene, {"part": ball()}, shading("principled"), size=16, spp=64)
    gbuffer = appearance.trace(camera(), seed=1)
    values = {name: value.requires_grad_() for name, value in fields(gbuffer).items()}
    pixel_losses(appearance, gbuffer, values).sum().backward()
    appearance._transport = SameLight(appearance)
    with torch.no_grad():
        pixel_losses(appearance, gbuffer, values)
        for name, value in values.items():
            for channel in range(value.shape[1]):
                moved = torch.zeros_like(value)
                moved[:, channel] = STEP[name]
                ends = [pixel_losses(appearance, gbuffer, {**values, name: value + s * moved}) for s in (1, -1)]
                expected = (ends[0] - ends[1]) / (2 * STEP[name])
                assert expected.abs().max() > 0.01
                scale = expected.abs().clamp(min=0.1 * float(expected.abs().max()))
                worst = float(((value.grad[:, channel] - expected).abs() / scale).max())
                assert worst < 0.03, f"{name}[{channel}]: off by {worst:.1%}"


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(name, marks=pytest.mark.slow) for name in ("base_color", "metallic")), "roughness", "normal"],
)
def test_the_whole_picture_matches_finite_differences(scene: EditScene, name: str) -> None:
    """With equal seeds only, so that sampled directions follow the material: detaching them biases nothing."""
    appearance = AppearancePass(scene, {"part": ball()}, shading("principled"), 8, 8192)
    gbuffer = appearance.trace(camera(), seed=1)
    values = {key: torch.tensor([value]).repeat(len(gbuffer.points), 1) for key, value in CONSTANT.items()}
    values["metallic"] += 0.5
    values["normal"] = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(gbuffer.points), 1)
    direction = torch.tensor([1.0, 0.5, 0.0]) if name == "normal" else torch.ones(1)
    # Pixels that grow brighter count positive and the others negative, or a sum over all would say nothing.
    each = torch.zeros(len(gbuffer.points), 1, requires_grad=True)
    moving = {**values, name: values[name] + each * direction}
    (slope,) = torch.autograd.grad(pixel_losses(appearance, gbuffer, moving, seed=9).sum(), each)
    weight = slope[:, 0].sign()

    def loss(amount: torch.Tensor) -> torch.Tensor:
        return pixel_losses(appearance, gbuffer, {**values, name: values[name] + amount * direction}) @ weight

    amount = torch.zeros((), requires_grad=True)
    (found,) = torch.autograd.grad(loss(amount), amount)
    with torch.no_grad():
        expected = (loss(torch.tensor(WIDE)) - loss(torch.tensor(-WIDE))) / (2 * WIDE)
    assert float(found) == pytest.approx(float(expected), rel=0.03)


@pytest.mark.parametrize("name", ["mlp", "grid"])
def test_directional_derivative_in_the_fields_weights(scene: EditScene, name: str) -> None:
    """In one group of weights, halfway between uphill and a random direction, with directions of light that follow the
    material. The step is small, since a larger one passes kinks of the perceptron's hidden layer."""
    field = TextureField(TextureConfig(levels=4, finest_resolution=16, log2_table=12), seed=3)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    appearance = AppearancePass(scene, {"part": ball()}, shading("principled"), SIZE, 8192)
    gbuffer = appearance.trace(camera(), seed=1)

    def loss(seed: int) -> torch.Tensor:
        values = field(gbuffer.points)
        fed = {channel: getattr(values, channel) for channel in (*CONSTANT, "normal")}
        return pixel_losses(appearance, gbuffer, fed, seed).sum()

    group = {key: value for key, value in field.named_parameters() if key.startswith(name)}
    loss(9).backward()
    slopes = {key: value.grad.clone() for key, value in group.items()}
    noise = {key: torch.randn(value.shape, generator=generator) for key, value in group.items()}
    uphill, sideways = (torch.cat([value.flatten() for value in part.values()]).norm() for part in (slopes, noise))
    direction = {key: slopes[key] / uphill + noise[key] / sideways for key in group}

    @torch.no_grad()
    def moved(step: float, seed: int) -> float:
        for key, value in group.items():
            value += step * direction[key]
        result = float(loss(seed))
        for key, value in group.items():
            value -= step * direction[key]
        return result

    found, expected = 0.0, 0.0
    for seed in (9, 20, 31, 42):
        field.zero_grad()
        loss(seed).backward()
        found += sum(float((value.grad * direction[key]).sum()) for key, value in group.items())
        expected += (moved(NARROW, seed) - moved(-NARROW, seed)) / (2 * NARROW)
    assert abs(expected) > 1
    assert found == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("plugin", ["diffuse", "roughconductor"])
def test_other_bsdfs_match_finite_differences(scene: EditScene, plugin: str) -> None:
    appearance = AppearancePass(scene, {"part": ball()}, shading(plugin), size=16, spp=64)
    gbuffer = appearance.trace(camera(), seed=1)
    used = (*shading(plugin).feeds, "normal")
    values = {key: value.requires_grad_() if key in used else None for key, value in fields(gbuffer).items()}
    pixel_losses(appearance, gbuffer, values).sum().backward()
    appearance._transport = SameLight(appearance)
    with torch.no_grad():
        pixel_losses(appearance, gbuffer, values)
        for name in used:
            direction = torch.randn(values[name].shape, generator=torch.Generator().manual_seed(0))
            ends = [
                pixel_losses(appearance, gbuffer, {**values, name: values[name] + s * direction}) for s in (5e-3, -5e-3)
            ]
            expected, found = (ends[0] - ends[1]) / 1e-2, (values[name].grad * direction).sum(dim=1)
            assert float((found - expected).norm() / expected.norm()) < 0.03, name


def test_nothing_reaches_the_base(tmp_path: Path) -> None:
    """Every number of base and light asks for its derivative and gets exactly zero; stock Mitsuba gives others."""
    bsdf = '<bsdf type="principled"><rgb name="base_color" value="0.7, 0.4, 0.2"/></bsdf>'
    edited = blocks(tmp_path, write_sky(tmp_path) + AREA, bsdf)
    appearance = AppearancePass(edited, {"part": ball()}, shading("principled"), SIZE, 16)
    parameters = mi.traverse(appearance.scene.lit)
    part = f"object_{len(appearance.scene.base_shapes)}."
    watched = [key for key, value in parameters.items() if dr.is_array_v(value) and dr.is_float_v(value)]
    watched = [key for key in watched if not key.startswith(part) and dr.width(parameters[key])]
    names = {name for key in watched for name in key.split(".")}
    assert {"base_color", "roughness", "vertex_positions", "radiance", "data"} <= names
    for key in watched:
        dr.enable_grad(parameters[key])
        parameters.set_dirty(key)
    parameters.update()
    gbuffer = appearance.trace(camera(fov=40.0), seed=1)
    values = {name: value.requires_grad_() for name, value in fields(gbuffer).items()}
    pictures = appearance.render(gbuffer, **values, seed=2)
    assert pictures.base_path.any() and not pictures.base_path.requires_grad and not pictures.alpha.requires_grad
    pictures.merged.square().sum().backward()
    assert all(float(value.grad.abs().sum()) > 0 for value in values.values())
    reached = [key for key in watched if not zero_gradient(parameters[key])]
    assert all(dr.grad_enabled(parameters[key]) for key in watched) and not reached
    eye = mi.ScalarTransform4f().look_at([4, 4, 4], [0, 1, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    sensor = mi.load_dict({"type": "perspective", "to_world": eye, "film": film})
    integrator = mi.load_dict({"type": "direct"})
    picture = mi.render(appearance.scene.lit, parameters, sensor=sensor, integrator=integrator, spp=16)
    dr.backward(dr.mean(picture, axis=None))
    reached = {key.partition(".")[2] for key in watched if not zero_gradient(parameters[key])}
    assert {"bsdf.base_color.value", "emitter.radiance.value", "scale"} <= reached


def zero_gradient(value: Any) -> bool:
    return not any(np.array(dr.grad(value)).ravel())


def test_a_bent_normal_that_faces_away_still_gives_light_and_gradients(scene: EditScene) -> None:
    appearance = AppearancePass(scene, {"part": ball()}, shading("principled"), 16, 64)
    gbuffer = appearance.trace(camera(), seed=1)
    values = fields(gbuffer, tilt=6.0)
    values["normal"].requires_grad_()
    pictures = appearance.render(gbuffer, **values, seed=2)
    pictures.merged.sum().backward()
    assert torch.isfinite(values["normal"].grad).all()
    assert torch.isfinite(pictures.merged).all()


def test_no_point_of_the_part_is_no_gradient(scene: EditScene) -> None:
    appearance = AppearancePass(scene, {"part": ball()}, shading("diffuse"), SIZE, 4)
    gbuffer = appearance.trace(camera(height=-9.0, fov=5.0), seed=1)
    assert len(gbuffer.points) == 0
    colour = torch.zeros(0, 3, requires_grad=True)
    pictures = appearance.render(gbuffer, colour, None, None, None, seed=1)
    pictures.merged.sum().backward()
    assert colour.grad.shape == (0, 3) and not pictures.part_path.any()


def test_squared_fields_reach_the_bsdf_squared(scene: EditScene) -> None:
    feeds = {"base_color": "specular_reflectance", "roughness": "alpha"}
    plain = AppearancePass(scene, {"part": ball()}, PartShading({"type": "roughconductor"}, feeds), SIZE, 4)
    squared = AppearancePass(
        scene, {"part": ball()}, PartShading({"type": "roughconductor"}, feeds, ["roughness"]), SIZE, 4
    )
    gbuffer = plain.trace(camera(), seed=1)
    values = fields(gbuffer)
    colour, rough = values["base_color"], values["roughness"]
    first = plain.render(gbuffer, colour, rough**2, None, None, seed=1).merged
    second = squared.render(squared.trace(camera(), seed=1), colour, rough, None, None, seed=1).merged
    assert torch.allclose(first, second, rtol=1e-5, atol=1e-6)
