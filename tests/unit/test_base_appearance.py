"""The base's material against textures, vertex colours and constants that are sampled here by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import INTEGRATOR, LIGHT, REGION
from PIL import Image

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene

BITMAP = '<texture type="bitmap" name="{name}"><string name="filename" value="paint.png"/>{inner}</texture>'
RAW = '<boolean name="raw" value="true"/>'
GOLD_AT_0_DEGREES = (1.00, 0.77, 0.34)


def box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (12, 3, 3), UVs (12, 3, 2) of a box's triangles and its size: every side has the whole picture."""
    corners, uvs = [], []
    for axis in range(3):
        for sign in (-1, 1):
            square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
            points = np.insert(square, axis, sign, axis=1) * [0.5, 0.4, 0.7]
            inwards = np.cross(points[1] - points[0], points[2] - points[0])[axis] * sign < 0
            for order in ((0, 1, 2), (0, 2, 3)):
                order = order[::-1] if inwards else order
                corners.append(points[list(order)])
                uvs.append(square[list(order)] / 2 + 0.5)
    return np.array(corners), np.array(uvs), np.array([0.5, 0.4, 0.7])


def write_obj(path: Path, corners: np.ndarray, uvs: np.ndarray) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners.reshape(-1, 3)]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in uvs.reshape(-1, 2)]
    lines += ["f " + " ".join(f"{3 * i + j}/{3 * i + j}" for j in (1, 2, 3)) for i in range(len(corners))]
    path.write_text("\n".join(lines) + "\n")


def scene_of(folder: Path, shape: str) -> EditScene:
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{INTEGRATOR}{LIGHT}{shape}{REGION}</scene>')
    return load_edit_scene(path)


@pytest.fixture
def painted(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A folder with `box.obj` and an 8-bit `paint.png`, and the picture's values (H, W, 3) in [0, 1]."""
    corners, uvs, _ = box()
    write_obj(tmp_path / "box.obj", corners, uvs)
    picture = np.random.default_rng(3).integers(0, 256, (6, 9, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "paint.png")
    return tmp_path, picture / 255


def surface_points(seed: int = 0, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Random points (N, 3) on the box, kept off its edges, and their UVs (N, 2)."""
    random = np.random.default_rng(seed)
    corners, uvs, _ = box()
    face, weights = random.integers(0, len(corners), count), random.dirichlet([2, 2, 2], count)
    return np.einsum("ij,ijk->ik", weights, corners[face]), np.einsum("ij,ijk->ik", weights, uvs[face])


def linear(values: np.ndarray) -> np.ndarray:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def bilinear(picture: np.ndarray, u: np.ndarray, v_down: np.ndarray) -> np.ndarray:
    """The picture at u to the right and v downwards from its upper left corner, repeated, its pixels in the middle."""
    height, width, _ = picture.shape
    x, y = u * width - 0.5, v_down * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros((len(u), 3))
    for dx in (0, 1):
        for dy in (0, 1):
            share = (x - left if dx else 1 - x + left) * (y - top if dy else 1 - y + top)
            total += share[:, None] * picture[(top + dy) % height, (left + dx) % width]
    return total


def luminance(colour: np.ndarray) -> np.ndarray:
    return colour @ [0.212671, 0.715160, 0.072169]


def lookup(scene: EditScene, points: np.ndarray, off: float = 0.0):
    canonical = torch.from_numpy(scene.frame.to_canonical(points) * (1 + off)).float()
    found = BaseAppearance(scene).lookup(canonical)
    assert found.base_color.dtype == torch.float32 and not found.base_color.requires_grad
    return found.base_color.numpy(), found.roughness.numpy()[:, 0], found.metallic.numpy()[:, 0], found.known.numpy()


def base_of(bsdf: str) -> str:
    return f'<shape type="obj" id="box"><string name="filename" value="box.obj"/>{bsdf}</shape>'


def nested(kind: str, inner: str, rest: str = "") -> str:
    return f'<bsdf type="{kind}">{rest}{inner}</bsdf>'


PAINT = BITMAP.format(name="{name}", inner="")
PRINCIPLED = nested(
    "principled",
    PAINT.format(name="base_color") + BITMAP.format(name="roughness", inner=RAW),
    '<float name="metallic" value="0.3"/>',
)
BUMP = '<texture type="bitmap" name="arbitrary"><string name="filename" value="paint.png"/>' + RAW + "</texture>"

# name: (BSDF, roughness (None: the picture's), metallic)
PAINTED = {
    "principled": (PRINCIPLED, None, 0.3),
    "twosided principled": (nested("twosided", PRINCIPLED), None, 0.3),
    "mask": (nested("mask", PRINCIPLED, '<float name="opacity" value="0.5"/>'), None, 0.3),
    "bumpmap": (nested("bumpmap", PRINCIPLED, BUMP), None, 0.3),
    "normalmap": (nested("normalmap", PRINCIPLED, BUMP.replace("arbitrary", "normalmap")), None, 0.3),
    "mask of bumpmap": (nested("mask", nested("bumpmap", PRINCIPLED, BUMP)), None, 0.3),
    "diffuse": (nested("diffuse", PAINT.format(name="reflectance")), 1, 0),
    "plastic": (nested("plastic", PAINT.format(name="diffuse_reflectance")), 0, 0),
    "roughplastic": (
        nested("roughplastic", PAINT.format(name="diffuse_reflectance"), '<float name="alpha" value="0.09"/>'), 0.3, 0),
    "conductor": (nested("conductor", PAINT.format(name="specular_reflectance")), 0, 1),
    "roughconductor": (
        nested("roughconductor", PAINT.format(name="specular_reflectance"),
               '<float name="alpha_u" value="0.04"/><float name="alpha_v" value="0.64"/>'), 0.4, 1),
}  # fmt: skip


@pytest.mark.parametrize("name", PAINTED)
def test_bitmaps_through_uvs(painted: tuple[Path, np.ndarray], name: str) -> None:
    bsdf, expected_roughness, expected_metallic = PAINTED[name]
    folder, picture = painted
    points, uv = surface_points()
    colour, roughness, metallic, known = lookup(scene_of(folder, base_of(bsdf)), points)
    assert known.all()
    assert np.abs(colour - bilinear(linear(picture), uv[:, 0], 1 - uv[:, 1])).max() < 2e-4
    if expected_roughness is None:
        expected_roughness = luminance(bilinear(picture, uv[:, 0], 1 - uv[:, 1]))
    assert np.abs(roughness - expected_roughness).max() < 2e-4
    assert np.abs(metallic - expected_metallic).max() < 1e-6


def test_points_off_the_surface_take_the_nearest_of_it(painted: tuple[Path, np.ndarray]) -> None:
    """In the middle of the box's sides a point just outside has its nearest point straight below."""
    folder, picture = painted
    points, uv = surface_points()
    size = box()[2]
    side = np.abs(np.abs(points / size) - 1).argmin(axis=1)
    moved = points.copy()
    moved[np.arange(len(points)), side] *= 1.05
    colour, *_ = lookup(scene_of(folder, base_of(PRINCIPLED)), moved)
    assert np.abs(colour - bilinear(linear(picture), uv[:, 0], 1 - uv[:, 1])).max() < 2e-4


def test_uv_transform_nearest_filter_and_raw(painted: tuple[Path, np.ndarray]) -> None:
    folder, picture = painted
    inner = '<transform name="to_uv"><scale x="2" y="0.5"/><translate x="0.1" y="0.2"/></transform>' + RAW
    texture = BITMAP.format(name="reflectance", inner=inner + '<string name="filter_type" value="nearest"/>')
    points, uv = surface_points()
    colour, *_ = lookup(scene_of(folder, base_of(nested("diffuse", texture))), points)
    x, y = 2 * uv[:, 0] + 0.1, 0.5 * (1 - uv[:, 1]) + 0.2
    expected = picture[np.floor(y * 6).astype(int) % 6, np.floor(x * 9).astype(int) % 9]
    assert np.mean(np.abs(colour - expected).max(axis=1) < 1e-4) > 0.99  # a few lie on the border of two pixels


def test_uvs_survive_a_transform_that_mirrors(painted: tuple[Path, np.ndarray]) -> None:
    folder, picture = painted
    transform = '<transform name="to_world"><scale x="-2" y="2" z="2"/><translate x="3"/></transform>'
    points, uv = surface_points()
    region = REGION.replace('<translate x="0" y="0.35" z="0"/>', '<translate x="3" y="0.8" z="0"/>')
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{INTEGRATOR}{LIGHT}{base_of(PRINCIPLED + transform)}{region}</scene>')
    colour, *_ = lookup(load_edit_scene(path), points * [-2, 2, 2] + [3, 0, 0])
    assert np.abs(colour - bilinear(linear(picture), uv[:, 0], 1 - uv[:, 1])).max() < 2e-4


def test_vertex_colours(tmp_path: Path) -> None:
    corners, _, _ = box()
    colours = np.random.default_rng(1).random((36, 3))
    lines = ["ply", "format ascii 1.0", "element vertex 36"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "r", "g", "b")]
    lines += ["element face 12", "property list uchar int vertex_indices", "end_header"]
    rows = np.column_stack([corners.reshape(-1, 3), colours])
    lines += [" ".join(f"{value:.9g}" for value in row) for row in rows]
    lines += [f"3 {3 * i} {3 * i + 1} {3 * i + 2}" for i in range(12)]
    (tmp_path / "box.ply").write_text("\n".join(lines) + "\n")
    texture = '<texture type="mesh_attribute" name="base_color"><string name="name" value="vertex_color"/></texture>'
    shape = (
        f'<shape type="ply" id="box"><string name="filename" value="box.ply"/>{nested("principled", texture)}</shape>'
    )
    random = np.random.default_rng(0)
    face, weights = random.integers(0, 12, 300), random.dirichlet([2, 2, 2], 300)
    points = np.einsum("ij,ijk->ik", weights, corners[face])
    expected = np.einsum("ij,ijk->ik", weights, colours.reshape(12, 3, 3)[face])
    colour, roughness, metallic, _ = lookup(scene_of(tmp_path, shape), points)
    assert np.abs(colour - expected).max() < 1e-4
    assert np.all(roughness == 0.5) and np.all(metallic == 0)


def test_gold_and_a_blend_of_it(tmp_path: Path) -> None:
    write_obj(tmp_path / "box.obj", *box()[:2])
    gold = nested("roughconductor", '<string name="material" value="Au"/><float name="alpha" value="0.25"/>')
    points, _ = surface_points(count=20)
    colour, roughness, metallic, _ = lookup(scene_of(tmp_path, base_of(gold)), points)
    assert np.abs(colour - GOLD_AT_0_DEGREES).max() < 0.1
    assert np.allclose(roughness, 0.5) and np.all(metallic == 1)
    red = nested("diffuse", '<rgb name="reflectance" value="0.6, 0.1, 0.2"/>')
    blend = nested("blendbsdf", red + gold, '<float name="weight" value="0.25"/>')
    mixed, roughness, metallic, _ = lookup(scene_of(tmp_path, base_of(blend)), points)
    assert np.allclose(mixed, 0.75 * np.array([0.6, 0.1, 0.2]) + 0.25 * colour, atol=1e-5)
    assert np.allclose(roughness, 0.75 + 0.25 * 0.5) and np.allclose(metallic, 0.25)


def test_curved_shapes_have_their_own_uvs(tmp_path: Path) -> None:
    """On Mitsuba's unit sphere u is the azimuth around z and v the angle from +z."""
    picture = np.random.default_rng(3).integers(0, 256, (6, 9, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "paint.png")
    shape = f'<shape type="sphere" id="ball">{nested("diffuse", PAINT.format(name="reflectance"))}</shape>'
    scene = scene_of(tmp_path, shape.replace("<bsdf", '<float name="radius" value="0.5"/><bsdf', 1))
    points = np.random.default_rng(0).normal(size=(300, 3))
    points *= 0.5 / np.linalg.norm(points, axis=1, keepdims=True)
    colour, *_ = lookup(scene, points)
    azimuth = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) % 1
    expected = bilinear(linear(picture / 255), azimuth, np.arccos(points[:, 2] / 0.5) / np.pi)
    assert np.median(np.abs(colour - expected).max(axis=1)) < 0.02
    assert np.mean(np.abs(colour - expected).max(axis=1) < 0.1) > 0.95


def test_each_shape_answers_with_its_own_bsdf_and_glass_is_left_out(tmp_path: Path) -> None:
    write_obj(tmp_path / "box.obj", *box()[:2])
    glass = '<shape type="cube" id="pane"><transform name="to_world"><scale value="0.2"/><translate x="1"/></transform>'
    rough = glass.replace("pane", "frost").replace('x="1"', 'x="-1"')
    rest = base_of(nested("diffuse", '<rgb name="reflectance" value="0.6, 0.1, 0.2"/>'))
    scene = scene_of(
        tmp_path,
        f'{glass}<bsdf type="dielectric"/></shape>{rest}{rough}<bsdf type="roughdielectric">'
        '<float name="alpha" value="0.16"/></bsdf></shape>',
    )
    appearance = BaseAppearance(scene)
    assert len(appearance.unreadable) == 1 and "pane" in appearance.unreadable[0]
    points = torch.from_numpy(scene.frame.to_canonical(np.array([[1.2, 0, 0], [0, 0.4, 0], [-1.2, 0, 0]]))).float()
    found = appearance.lookup(points)
    assert found.known.tolist() == [[False] * 5, [True] * 5, [False] * 3 + [True, False]]
    assert torch.allclose(found.base_color[1], torch.tensor([0.6, 0.1, 0.2]))
    assert found.roughness[2].item() == pytest.approx(0.4)
    part = torch.rand(3, 5, generator=torch.Generator().manual_seed(0), requires_grad=True)
    style = found.style(otherwise=part)
    assert not style.requires_grad and torch.equal(style[0], part[0]) and torch.equal(style[1], found.style()[1])
    assert torch.allclose(appearance.distance(points), torch.zeros(3), atol=1e-6)


def test_glass_alone_is_an_error(tmp_path: Path) -> None:
    write_obj(tmp_path / "box.obj", *box()[:2])
    scene = scene_of(tmp_path, base_of('<bsdf type="dielectric"/>'))
    with pytest.raises(UserError, match=r"box.*style=false") as caught:
        BaseAppearance(scene)
    assert "\n" not in str(caught.value) and str(scene.path) in str(caught.value)


def test_a_custom_bsdf_with_principled_names(tmp_path: Path, mi) -> None:
    class Paint(mi.BSDF):
        def __init__(self, properties):
            super().__init__(properties)
            self.colour = properties["base_color"]
            self.rough = properties["roughness"]
            self.m_components, self.m_flags = [mi.BSDFFlags.DiffuseReflection], mi.BSDFFlags.DiffuseReflection

        def traverse(self, callback):
            callback.put("base_color", self.colour, mi.ParamFlags.Differentiable)
            callback.put("roughness", self.rough, mi.ParamFlags.Differentiable)

    mi.register_bsdf("test_paint", lambda properties: Paint(properties))
    write_obj(tmp_path / "box.obj", *box()[:2])
    colour = '<texture type="srgb" name="base_color"><rgb name="color" value="0.6, 0.1, 0.2"/></texture>'
    rough = '<texture type="uniform" name="roughness"><float name="value" value="0.7"/></texture>'
    scene = scene_of(tmp_path, base_of(nested("test_paint", colour + rough)))
    found, roughness, metallic, known = lookup(scene, surface_points(count=5)[0])
    assert known.all() and np.allclose(found, [0.6, 0.1, 0.2]) and np.allclose(roughness, 0.7) and not metallic.any()


def test_other_numbers_of_points_compile_no_kernel(painted: tuple[Path, np.ndarray]) -> None:
    import drjit as dr

    scene = scene_of(painted[0], base_of(PRINCIPLED))
    appearance = BaseAppearance(scene)
    appearance.lookup(torch.rand(50, 3, generator=torch.Generator().manual_seed(0)))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for count in (7, 120, 333, 64):
            found = appearance.lookup(torch.rand(count, 3, generator=torch.Generator().manual_seed(1)))
            assert found.style().shape == (count, 5)
        launched = [entry for entry in dr.kernel_history() if "cache_hit" in entry]
    assert launched and all(entry["cache_hit"] for entry in launched)
