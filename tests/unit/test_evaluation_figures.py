"""Figures of the evaluation against scikit-image, libigl, trimesh, and numbers worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import igl
import numpy as np
import pytest
import torch
import trimesh
from conftest import BASE, PART
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from fd_mitsuba.config import TextureConfig
from fd_mitsuba.evaluation.base_drift import chamfer, export_drift, picture_drift
from fd_mitsuba.evaluation.boundary_step import boundary_step
from fd_mitsuba.evaluation.front_in_back import front_in_back
from fd_mitsuba.evaluation.judged_views import JudgedViews
from fd_mitsuba.evaluation.part_check import check_parts
from fd_mitsuba.evaluation.picture_difference import MOST_DECIBELS, psnr, ssim, ssim_map
from fd_mitsuba.evaluation.protocol import judged
from fd_mitsuba.evaluation.similarity import EditPrompt, clip_scores, rank_of, retrieval
from fd_mitsuba.export.meshes import copy_base
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.part_material import PlainMaterial

ALL = torch.ones(1, 1, 40, 48, dtype=torch.bool)


@pytest.fixture(scope="module")
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth picture (1, 3, 40, 48) and the same with noise."""
    random = np.random.default_rng(4)
    x, y = np.meshgrid(np.linspace(0, 6, 48), np.linspace(0, 5, 40))
    smooth = np.stack([0.5 + 0.4 * np.sin(x + k) * np.cos(y - k) for k in range(3)])
    noisy = np.clip(smooth + random.normal(0, 0.08, smooth.shape), 0, 1)
    return torch.from_numpy(smooth)[None], torch.from_numpy(noisy)[None]


def channels_last(picture: torch.Tensor) -> np.ndarray:
    return picture[0].permute(1, 2, 0).numpy()


def test_psnr_equals_scikit_image(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    expected = peak_signal_noise_ratio(*map(channels_last, pair), data_range=1)
    assert psnr(*pair, ALL) == pytest.approx(expected, abs=1e-9)
    assert psnr(pair[0], pair[0], ALL) == MOST_DECIBELS and psnr(*pair, ~ALL) is None


def test_psnr_counts_the_mask_alone(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    left = ALL.clone()
    left[..., 20:] = False
    expected = peak_signal_noise_ratio(*(channels_last(picture)[:, :20] for picture in pair), data_range=1)
    assert psnr(*pair, left) == pytest.approx(expected, abs=1e-9)


def test_ssim_equals_scikit_image(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    mean, full = structural_similarity(*map(channels_last, pair), channel_axis=2, full=True, **settings)
    mine = ssim_map(*pair)[0].permute(1, 2, 0).numpy()
    assert np.abs(mine - full[5:-5, 5:-5]).max() < 1e-9
    assert ssim(*pair, ALL) == pytest.approx(mean, abs=1e-9)  # scikit-image leaves the same rim out of its mean


def test_ssim_leaves_out_what_may_differ(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    changed = pair[0].clone()
    changed[..., 10:20, 10:20] = 0
    equal = ALL.clone()
    equal[..., 10:20, 10:20] = False
    assert ssim(pair[0], changed, ALL) < 0.9 and ssim(pair[0], changed, ALL, equal) == pytest.approx(1, abs=1e-12)
    changed[..., 25, 25] += 0.3  # beside it a difference is seen
    assert ssim(pair[0], changed, ALL, equal) < 1 - 1e-4
    one = ALL & False
    one[..., 30, 30] = True
    assert ssim(*pair, one) == pytest.approx(float(ssim_map(*pair)[..., 25, 25].mean()))
    assert ssim(*pair, ~ALL) is None and ssim(pair[0][..., :10, :], pair[1][..., :10, :], ALL[..., :10, :]) is None


def test_picture_drift_tells_shadows_from_changed_colours() -> None:
    base = torch.full((2, 3, 32, 32), 0.5)
    edited = base.clone()
    pixels = torch.ones(2, 1, 32, 32, dtype=torch.bool)
    pixels[..., :4] = False  # the part
    edited[..., :4] = 0.9
    untouched = pixels.clone()
    untouched[..., 4:8] = False  # its shadow
    edited[..., 4:8] = 0.4
    views = JudgedViews("lit", np.zeros(2), edited, base, base, pixels, untouched)
    found = picture_drift(views)
    assert found["psnr_db"] == MOST_DECIBELS and found["colour_drift"] == 0 and found["ssim"] == pytest.approx(1)
    assert found["psnr_lit_db"] == pytest.approx(-10 * math.log10(0.01 * 4 / 28), abs=1e-5)
    assert found["untouched_share"] == pytest.approx(24 / 28)
    edited[..., 20, 20] += 0.1
    found = picture_drift(views)
    assert found["colour_drift"] == pytest.approx(0.1 / (24 * 32), rel=1e-4) and found["ssim"] < 1


class HandMade:
    """Two dimensions: pictures lie along their mean red and green, sentences where the test puts them."""

    name = "hand made"
    version = "1"
    geometry_pictures = "normals"

    def __init__(self, **places: tuple[float, float]) -> None:
        self.places = places

    def texts(self, texts: list[str]) -> torch.Tensor:
        return torch.tensor([self.places[text] for text in texts])


def test_clip_scores_by_hand() -> None:
    judge = HandMade(after=(0.0, 2.0), before=(3.0, 0.0))
    edited = torch.tensor([[0.0, 5.0], [0.6, 0.8]])  # the feature of the text itself; halfway to it
    base = torch.tensor([[1.0, 0.0], [10.0, 0.0]])
    found = clip_scores(judge, edited, base, EditPrompt("after", "before"))
    assert found["sim"] == pytest.approx((1 + 0.8) / 2) and found["sim_base"] == pytest.approx(0, abs=1e-7)
    # Changes of pictures (-1, 1) and (-0.4, 0.8), of texts (-1, 1).
    assert found["dir_dot"] == pytest.approx((2 + 1.2) / 2)
    assert found["dir_cosine"] == pytest.approx((1 + 1.2 / (math.sqrt(0.8) * math.sqrt(2))) / 2)
    assert "dir_dot" not in clip_scores(judge, edited, base, EditPrompt("after"))


def test_retrieval_by_hand() -> None:
    judge = HandMade(crown=(0.0, 1.0), hat=(0.7, 0.7), cat=(1.0, 0.0), dog=(-1.0, 0.1), bone=(-1.0, 0.0))
    candidates = [EditPrompt("crown", "cat"), EditPrompt("hat", "cat"), EditPrompt("bone", "dog")]
    edited, base = torch.tensor([[0.6, 0.8], [0.8, 0.6]]), torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    found = retrieval(judge, edited, base, candidates, 0)
    assert found["rank"] == 2 and found["first_views"] == 0 and found["candidates"] == 3  # both views look like the hat
    assert found["rank_dir"] == 1  # but the change goes furthest towards the crown
    assert rank_of([0.3, 0.5, 0.3], 0) == 3 and rank_of([0.3, 0.5, 0.3], 1) == 1


def test_a_start_that_looks_like_the_base_ranks_behind_the_base_prompt() -> None:
    judge = HandMade(crown=(0.0, 1.0), cat=(1.0, 0.0), bone=(-1.0, 0.0), dog=(-1.0, 0.1))
    judge.images = lambda pictures: pictures
    edited, start, base = (torch.tensor([place] * 8) for place in ((0.2, 1.0), (1.0, 0.4), (1.0, 0.0)))
    views = SimpleNamespace(edited=edited, start=start, base=base, azimuth_deg=np.arange(8) * 45.0, kind="normals")
    found = judged(views, judge, EditPrompt("crown", "cat"), None, [EditPrompt("bone", "dog")], None)
    alone, with_base = found["retrieval"], found["retrieval_with_base"]
    assert (alone["rank"], alone["rank_start"], alone["candidates"]) == (1, 1, 2)  # no other sentence has a cat
    assert (with_base["rank"], with_base["rank_start"], with_base["candidates"]) == (1, 2, 3)


def test_front_in_back_counts_back_views_that_look_like_the_front() -> None:
    azimuth = np.arange(20) * 18.0
    angle = torch.from_numpy(np.radians(azimuth))
    base = torch.stack([torch.cos(angle), torch.sin(angle), torch.full_like(angle, 0.5)], dim=1)
    assert front_in_back(base, base, azimuth).excess == 0
    janus = base.clone()
    janus[:, 0] = janus[:, 0].abs()
    found = front_in_back(janus, base, azimuth)
    # Both sides look the same: three of the five back views lean to the front of their own mean, by hand.
    assert found.share == pytest.approx(0.6) and found.base_share == 0 and found.confusion == 0
    assert found.excess == pytest.approx(0.6)
    hat = base + torch.tensor([0.6, 0.0, 2.0])  # the same in every view, and by chance nearer to the base's front
    assert front_in_back(hat, base, azimuth).excess == 0
    # A vase: almost the same from all sides, so that what a flower on it leans to says nothing.
    vase = torch.stack([0.02 * torch.cos(angle), 0.02 * torch.sin(angle), torch.ones_like(angle)], dim=1)
    found = front_in_back(vase, vase, azimuth)
    assert found.confusion == 0 and found.excess is None
    mean = np.cos(np.radians([0, 18, 36])) @ [1, 2, 2] / 5 * 0.02  # of the front's five views, and minus that behind
    assert found.separation == pytest.approx(2 * mean / np.hypot(1, mean), rel=1e-3)
    blind = torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert front_in_back(blind, blind, azimuth).excess is None
    assert front_in_back(base[:3], base[:3], azimuth[:3]) is None


def test_chamfer_equals_libigls_distances() -> None:
    one, other = trimesh.creation.icosphere(3, 1.0), trimesh.creation.box((1.5, 1.5, 1.5)).subdivide().subdivide()
    means = []
    for source, target in ((one, other), (other, one)):
        points = trimesh.sample.sample_surface(source, 20_000, seed=5)[0]
        points = np.concatenate([np.asarray(source.vertices), points])
        squared = igl.point_mesh_squared_distance(points, np.asarray(target.vertices), np.asarray(target.faces))[0]
        means.append(np.sqrt(squared).mean())
    arrays = [(np.asarray(mesh.vertices), np.asarray(mesh.faces)) for mesh in (one, other)]
    assert chamfer(*arrays, seed=5) == pytest.approx(np.mean(means), rel=1e-12)
    assert chamfer(arrays[0], arrays[0]) < 1e-12
    lifted = (arrays[1][0] * 1.0 + [0, 0, 0], arrays[1][1])
    outer = (arrays[1][0] * 1.1, arrays[1][1])
    assert 0.07 < chamfer(lifted, outer) < 0.09  # 0.075 between the faces of the boxes, more at the outer corners


SceneWriter = Callable[..., Path]
TEXTURED = BASE.replace(
    '<bsdf type="diffuse"/>',
    '<bsdf type="principled"><rgb name="base_color" value="0.5, 0.2, 0.1"/>'
    '<texture name="roughness" type="bitmap"><string name="filename" value="rough.png"/></texture></bsdf>',
)


def test_export_drift_finds_a_moved_vertex_and_a_changed_pixel(make_scene: SceneWriter, tmp_path: Path) -> None:
    picture = np.full((4, 4), 100, np.uint8)
    Image.fromarray(picture).save(tmp_path / "rough.png")
    scene = load_edit_scene(make_scene(base=TEXTURED))
    exported = tmp_path / "run" / "export" / "base"
    copy_base(scene, exported, [tmp_path / "rough.png"])
    found = export_drift(scene, tmp_path / "run")
    assert found["chamfer"] < 1e-12 and found["files"] == found["files_identical"] == 2 and found["missing"] == []
    assert found["textures"] == 1 and found["texture_difference"] == 0
    picture[1, 2] = 151
    Image.fromarray(picture).save(exported / "rough.png")
    lines = (exported / "animal.ply").read_text().splitlines()
    start = lines.index("end_header") + 1
    lines[start] = "2 2 2"
    (exported / "animal.ply").write_text("\n".join(lines) + "\n")
    found = export_drift(scene, tmp_path / "run")
    assert found["texture_difference"] == pytest.approx(51 / 255) and found["files_identical"] == 0
    assert found["chamfer"] > 1e-3
    (exported / "animal.ply").unlink()
    found = export_drift(scene, tmp_path / "run")
    assert found["chamfer"] is None and found["missing"] == ["animal.ply"]


def test_boundary_step_of_plain_colours(make_scene: SceneWriter) -> None:
    from fd_mitsuba.render.tonemap import to_srgb

    plain = BASE.replace(
        '<bsdf type="diffuse"/>', '<bsdf type="principled"><rgb name="base_color" value="0.4"/></bsdf>'
    )
    scene = load_edit_scene(make_scene(base=plain, part=PART))
    region = scene.regions[0].surface(3)
    field = TextureField(TextureConfig(levels=1, log2_table=4), 0, PlainMaterial((0.1, 0.4, 0.4), 0.5, 0.0), ())
    step = float((to_srgb(torch.tensor(0.4)) - to_srgb(torch.tensor(0.1))) / math.sqrt(3))
    assert boundary_step(scene, [region], field, 0.2) == pytest.approx(step, rel=1e-4)
    far = SimpleNamespace(vertices=region.vertices + 5, faces=region.faces)
    assert boundary_step(scene, [far], field, 0.2) is None


def test_parts_are_checked_from_their_files(tmp_path: Path) -> None:
    folder = tmp_path / "export"
    folder.mkdir()
    ball = trimesh.creation.icosphere(3, 0.5)
    ball.export(folder / "part_ball.ply")
    trimesh.util.concatenate([ball, ball.copy().apply_translation([3, 0, 0])]).export(folder / "part_two.ply")
    trimesh.Trimesh(ball.vertices, ball.faces[:-1], process=False).export(folder / "part_open.ply")
    found = check_parts(["ball", "two", "open", "none"], tmp_path, scale=2.0)
    assert found["ball"]["valid"] and found["ball"]["volume"] == pytest.approx(8 * 4 / 3 * np.pi / 8, rel=0.02)
    assert found["two"]["valid"] and found["two"]["pieces"] == 2 and found["ball"]["pieces"] == 1
    assert not found["open"]["valid"] and not found["open"]["closed"]
    assert found["none"]["lost"] and not found["none"]["valid"]
