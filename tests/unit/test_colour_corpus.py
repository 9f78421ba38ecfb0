"""The appearance prior's training pictures: what differs between a pair, which colours come out."""

from __future__ import annotations

import re

import numpy as np
import pytest
from skimage.color import rgb2lab

from fd_mitsuba.prior.data import looks
from fd_mitsuba.prior.data.captions import COLOURS, MATERIALS, PART_WORDS, vocabulary
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.judging.evaluate_colour import balanced_cases, colours, prompt
from fd_mitsuba.prior.pictures import light
from fd_mitsuba.prior.pictures.colour_corpus import colour_caption, make_colour_pairs, part_views

WHITE = np.ones((light.HEIGHT, light.WIDTH, 3))


def lab(colour: np.ndarray) -> np.ndarray:
    return rgb2lab(np.asarray(colour, float)[None, None])[0, 0]


def test_pairs_follow_from_the_seed() -> None:
    first, again, other = (make_colour_pairs("duck", ["crown"], seed) for seed in (3, 3, 4))
    assert len(first) == len(again) > 2
    for a, b in zip(first, again, strict=True):
        assert a.caption == b.caption and np.array_equal(a.edited, b.edited) and np.array_equal(a.base, b.base)
    assert not np.array_equal(first[0].edited, other[0].edited)


def test_a_pair_differs_only_where_the_part_is() -> None:
    for pair in make_colour_pairs("mug", ["handle", None, "pointed hat"], 5):
        assert pair.base.shape == pair.edited.shape == (4, 64, 64) and pair.part_coverage.shape == (64, 64)
        changed = (pair.base != pair.edited).any(0)
        assert changed.sum() > 15 and not changed[pair.part_coverage == 0].any()
        assert (pair.edited[3].astype(int) > -127).sum() > 200  # the body is there
        assert pair.base[:, 0, 0].tolist() == [-127] * 4 or pair.closeup  # on black


def test_named_colours_come_out_near_their_anchors_under_white_light() -> None:
    view = next(iter(part_views("ball", ["top hat"], np.random.default_rng(0))))
    for name in COLOURS:
        _, edited, coverage = view.paint((looks.NAMED[name],), None, light.lit_by(WHITE), np.random.default_rng(1))
        seen = lab(colours(edited / 127)[coverage > 250].mean(0))
        distance = {other: np.linalg.norm(seen[1:] - lab(np.array(looks.NAMED[other].first) / 255)[1:])
                    for other in COLOURS if other not in ("black", "white")}  # fmt: skip
        if name in ("black", "white"):
            assert np.linalg.norm(seen[1:]) < 8
        else:
            assert min(distance, key=distance.__getitem__) == name


def test_metal_mirrors_and_keeps_its_hue() -> None:
    """Under a light from one side only, gold away from it is darker than a matt surface and still yellow."""
    lamp = np.exp(8 * (light.directions()[..., 0] - 1))[..., None] * np.ones(3)
    lit = light.lit_by(lamp)
    normal = np.array([[0.6, 0, 0.8], [0.0, 0, 1.0]], np.float32)
    towards = np.array([[0, 0, 1.0]] * 2, np.float32)
    zone, rough = np.zeros(2, int), np.array([0.28], np.float32)
    colour = np.tile(looks.linear(looks.NAMED["gold"].first), (2, 1))
    gold, matt = (light.reflected(lit, normal, towards, zone, colour, rough, np.float32([m])) for m in (1, 0))
    assert (gold[0] > 2 * matt[0]).all() and (gold[1] < 0.5 * matt[1]).all()
    np.testing.assert_allclose(gold[0] / gold[0].max(), colour[0] / colour[0].max(), atol=0.1)


def test_a_white_surface_in_white_light_gains_nothing() -> None:
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    towards = rng.normal(size=(500, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    towards *= np.sign(np.einsum("ij,ij->i", normal, towards))[:, None]
    lit = light.lit_by(WHITE)
    np.testing.assert_allclose(lit.diffuse, 1, atol=1e-5)
    np.testing.assert_allclose(lit.glossy, 1, atol=1e-5)
    for roughness in (0.2, 0.5, 1.0):
        sent = light.reflected(
            lit, normal, towards, np.zeros(500, int), np.ones((500, 3)), np.float32([roughness]), np.float32([1.0])
        )
        assert sent.max() < 1.01 and (roughness > 0.2 or sent.mean() > 0.95)  # rough facets shade each other


@pytest.mark.parametrize(
    ("colour", "roughness", "metallic"),
    [((0.8, 0.1, 0.1), 0.5, 0.0), ((1, 0.77, 0.34), 0.3, 1.0), ((1, 0.77, 0.34), 0.75, 1.0)],
)
def test_shading_is_that_of_mitsubas_principled_bsdf(
    mi: object, colour: tuple[float, float, float], roughness: float, metallic: float
) -> None:
    """A sphere under an uneven sky, against a path-traced one."""
    size, sky = 40, light._invented_sky(np.random.default_rng(0)).astype(np.float32)
    sky /= sky.mean()
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
            "light": {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(sky))},
            "ball": {
                "type": "sphere",
                "bsdf": {
                    "type": "principled",
                    "base_color": {"type": "rgb", "value": list(colour)},
                    "roughness": roughness,
                    "metallic": metallic,
                },
            },
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 128},
            },
        },
        parallel=False,
    )
    truth = np.array(mi.render(scene, seed=1))
    grid = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(grid * np.tan(np.pi / 8), -grid * np.tan(np.pi / 8))
    ray = np.stack([x, y, -np.ones_like(x)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = 3 * ray[..., 2]
    root = along**2 - 8
    hit = root > 0.05  # not the rim, whose pixels are partly covered
    point = np.array([0, 0, 3]) - (along + np.sqrt(np.where(hit, root, 0)))[..., None] * ray
    count = hit.sum()
    sent = light.reflected(
        light.lit_by(sky), point[hit], -ray[hit], np.zeros(count, int), np.tile(np.float32(colour), (count, 1)),
        np.float32([roughness]), np.float32([metallic]),
    )  # fmt: skip
    exposure = 0.3 / truth[hit][:, :3].mean()
    ours, theirs = (np.clip(value * exposure, 0, 1) ** (1 / 2.2) for value in (sent, truth[hit][:, :3]))
    assert count > 500 and np.abs(ours - theirs).mean() < 0.025 and abs((ours - theirs).mean()) < 0.015


def test_captions_say_what_is_painted() -> None:
    rng, known = np.random.default_rng(0), set(vocabulary())
    seen = set()
    for _ in range(400):
        text, adjective, material = colour_caption("horse", "crown", rng)
        assert set(re.findall(r"[^\s,]+", text)) <= known, text
        words = text.split()
        styles = [looks.STYLE_OF_WORD[w] for w in words[2:] if w in looks.STYLE_OF_WORD]
        styles = [s for s in styles if s != adjective or words.count(s) > 1] if adjective else styles
        assert (material is None) == (not styles), text
        if len(styles) == 1:
            assert material == looks.NAMED[styles[0]]
            seen.add(styles[0])
        if "golden" in words:
            assert material.metallic == 1 or len(styles) > 1
    assert seen == {*COLOURS, *MATERIALS}
    assert looks.named_look(["red", "plastic"]).first == looks.NAMED["red"].first
    assert looks.named_look(["round"]) is None


def test_every_part_has_its_looks_and_zones() -> None:
    assert set(looks.NATURAL) == set(PARTS) == set(PART_WORDS)
    assert set(looks.NAMED) == {*COLOURS, *MATERIALS}
    for part, choices in looks.NATURAL.items():
        zone = looks.zones(part, np.arange(11), 11)
        for look in choices:
            assert len(look) == 1 or zone.max() + 1 <= len(look)


def test_balanced_cases_cover_all_styles() -> None:
    cases = balanced_cases(48)
    styles = [style for _, _, style in cases]
    assert {styles.count(style) for style in looks.NAMED} == {3}
    assert prompt("horse", "wings", "gold") == "a horse with golden wings"


def test_cielab_is_skimages() -> None:
    colour = np.random.default_rng(0).random((50, 3))
    np.testing.assert_allclose(looks.cielab(colour), rgb2lab(colour[None])[0], atol=0.05)
