"""The finer prior's data: closed parts on every body, removal, words; its network starts from the coarse one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.nn.functional import avg_pool2d

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.builtin import BUILTIN_FOLDER, WIDE_FOLDER, builtin_folder
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.prior.data import captions as coarse_captions
from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.captions import styled
from fd_mitsuba.prior.data.catalogue import FINE
from fd_mitsuba.prior.data.fine.bodies import BODIES, NAMELESS
from fd_mitsuba.prior.data.fine.captions import BODY_WORDS, NEUTRAL, PART_WORDS, bare, caption, vocabulary, word_lists
from fd_mitsuba.prior.data.fine.looks import NATURAL, zone_of_piece
from fd_mitsuba.prior.data.fine.parts import FITTED, PARTS, suits
from fd_mitsuba.prior.data.fine.placement import FEET, varied
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import Solid, join
from fd_mitsuba.prior.pictures.colour_corpus import pieces_of
from fd_mitsuba.prior.pictures.corpus import RayCaster
from fd_mitsuba.prior.pictures.fine_corpus import VIEW_SIZE, FinePair, make_fine_pairs
from fd_mitsuba.prior.training.kinds import GEOMETRY, GEOMETRY_FINE, GEOMETRY_WIDE
from fd_mitsuba.prior.training.model import TEXT_LENGTH, build_scheduler, build_tokenizer, tokenize
from fd_mitsuba.prior.training.pool import draw_pairs
from fd_mitsuba.prior.training.warm_start import load_start
from tests.unit.test_prior_corpus import closed_volumes


def made(name: str, seed: int) -> tuple[Body, Surface, np.random.Generator]:
    random = np.random.default_rng(seed)
    body = BODIES[name](random)
    return body, Surface(body), random


def scattered(solid: Solid, count: int, random: np.random.Generator) -> np.ndarray:
    """Points (count, 3) on a mesh, evenly by area."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = random.choice(len(area), count, p=area / area.sum())
    u, v = np.sort(random.random((2, count)), axis=0)
    return a[face] * u[:, None] + b[face] * (v - u)[:, None] + c[face] * (1 - v)[:, None]


@pytest.mark.parametrize("name", BODIES)
def test_bodies_and_parts_are_closed_face_outwards_and_touch(name: str) -> None:
    for seed in range(2):
        body, surface, random = made(name, seed)
        low, high = body.solid.vertices.min(0), body.solid.vertices.max(0)
        assert (high - low).max() == pytest.approx(1.8) and np.abs(low + high).max() < 1e-9
        on_surface = scattered(body.solid, 6000, random)
        for part, make in PARTS.items():
            if not suits(name, part):
                continue
            zones = make(surface, random)
            assert zones, part
            for zone, solid in zones.items():
                assert np.isfinite(solid.vertices).all(), (part, zone)
                assert closed_volumes(solid).min() > 0, (part, zone)
            points = join(list(zones.values())).vertices
            assert np.abs(points).max() < 3.0, part
            if part != "halo":
                gap = cKDTree(on_surface).query(points[::7])[0].min()
                assert gap < 0.12, (part, gap)


@pytest.mark.parametrize("part", PARTS)
def test_every_part_shows_on_what_it_suits(part: str) -> None:
    names = [name for name in BODIES if suits(name, part)][::4]
    pairs = [pair for name in names for pair in make_fine_pairs(name, [part], 17)]
    assert np.mean([pair.shows_part() for pair in pairs]) >= 0.9
    assert all(pair.base.shape == (4, 2 * VIEW_SIZE, 2 * VIEW_SIZE) and pair.base.dtype == np.int8 for pair in pairs)


def test_every_part_has_a_place() -> None:
    assert set(FEET) | set(FITTED) == set(PARTS) and not set(FEET) & set(FITTED)
    assert list(PART_WORDS) == list(PARTS) and list(BODY_WORDS) == list(BODIES), "claims go by these orders"


def test_pairs_follow_from_the_seed() -> None:
    first, again, other = (make_fine_pairs("dragon", ["crown", "bat wings", None], seed) for seed in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.base, b.base) and np.array_equal(a.edited, b.edited) and a.caption == b.caption
    assert not np.array_equal(first[0].edited, other[0].edited)


@pytest.fixture(scope="module")
def drawn() -> list[FinePair]:
    """400 pairs, as a training draws them."""
    random, pairs = np.random.default_rng(0), []
    while len(pairs) < 400:
        pairs += draw_pairs(GEOMETRY_FINE, random)
    return pairs  # type: ignore[return-value]


def test_a_part_adds_to_the_picture_and_a_removal_takes_from_it(drawn: list[FinePair]) -> None:
    pairs = [pair for pair in drawn if pair.part and not pair.beside]
    removed = [pair for pair in pairs if pair.removed]
    assert 0.04 < len(removed) / len(pairs) < 0.17
    for pair in pairs:
        before, after = pair.base[3] > -127, pair.edited[3] > -127
        more, less = (before, after) if pair.removed else (after, before)
        assert not (less & ~more).any(), "a part covers, it never uncovers"
        says_so = " without " in pair.caption or " with no " in pair.caption
        assert says_so == pair.removed, pair.caption
    assert any(pair.beside for pair in drawn)


def test_training_never_shows_what_is_kept_for_the_evaluation(drawn: list[FinePair]) -> None:
    shown = {(pair.body, pair.part) for pair in drawn}
    assert not shown & GEOMETRY_FINE.catalogue.held_out
    assert all(part is None or suits(body, part) for body, part in shown)


def test_parts_are_also_where_they_usually_are_not() -> None:
    """A prior that knows one place a body cannot follow a region that is drawn elsewhere."""
    _, surface, random = made("horse", 1)
    crown = join(list(PARTS["crown"](surface, random).values()))
    centres = np.array([varied("crown", crown, surface, random).vertices.mean(0) for _ in range(60)])
    away = np.linalg.norm(centres - crown.vertices.mean(0), axis=1)
    assert 2 <= (away > 0.4).sum() <= 25 and np.median(away) < 0.15


def test_every_caption_is_whole_words_that_fit() -> None:
    tokenizer, random, known = build_tokenizer(vocabulary()), np.random.default_rng(0), set(vocabulary())
    for body in BODY_WORDS:
        for part in PART_WORDS:
            text = caption(body, part, random, bool(random.random() < 0.3))
            words = text.split()
            assert set(words) <= known, text
            assert len(tokenizer(text).input_ids) == len(words) + 2 <= TEXT_LENGTH - 4
    assert set(coarse_captions.vocabulary()) <= known


def test_bodies_without_a_name_are_called_so_and_others_now_and_then() -> None:
    random = np.random.default_rng(1)
    assert all(caption(NAMELESS, "hat", random).startswith(NEUTRAL) for _ in range(50))
    neutral = np.mean([caption("horse", "hat", random).startswith(NEUTRAL) for _ in range(1000)])
    assert 0.1 < neutral < 0.2


def test_the_vocabulary_reads_prompts_with_the_new_words() -> None:
    words = Vocabulary.model_validate(word_lists())
    assert read_prompt("an elephant wearing a bow tie", words).parts == ("bow tie",)
    assert read_prompt("a dragon with bat wings", words).bodies == ("dragon",)
    assert "bat wings" in read_prompt("a dragon with bat wings", words).parts
    assert bare("an umbrella") == "umbrella"
    assert styled("an umbrella", "red") == "a red umbrella"
    assert styled("an umbrella", "orange") == "an orange umbrella"
    assert styled("an umbrella", "made of wood") == "an umbrella made of wood"


def test_glasses_reach_from_before_the_eyes_to_behind_the_middle_of_the_head() -> None:
    for seed in range(4):
        body, surface, random = made("head", seed)
        frame = PARTS["glasses"](surface, random)["frame"].vertices
        assert frame[:, 2].max() > body.eyes()[:, 2].min()
        assert frame[:, 2].min() < surface.head[2] - 0.1 * surface.size
        assert np.ptp(frame[:, 0]) > 1.6 * surface.size


def test_a_hats_brim_lies_outside_the_head() -> None:
    for name in ("person", "head", "snowman", "ball"):
        body, surface, random = made(name, 2)
        brim = PARTS["pointed hat"](surface, random)["hat"].vertices
        widest = brim[np.linalg.norm(brim[:, [0, 2]] - body.head_top[[0, 2]], axis=1) > 1.5 * surface.size]
        assert len(widest) > 20
        up = np.tile([0.0, 1.0, 0.0], (len(widest), 1))
        distance, _ = RayCaster(body.solid).cast(widest, up)
        assert np.isfinite(distance).mean() < 0.05, "above the brim there is no more of the body"


def test_the_finer_network_starts_with_what_the_coarse_one_knows(drawn: list[FinePair]) -> None:
    kind, tokenizer = GEOMETRY_FINE, build_tokenizer(GEOMETRY_FINE.catalogue.vocabulary)
    torch.manual_seed(0)
    modules = kind.build_modules(tokenizer)
    load_start(BUILTIN_FOLDER, modules, tokenizer, kind.prediction)
    pairs = [p for p in drawn[:60] if p.part in GEOMETRY.catalogue.part_weights and not p.removed and not p.beside][:8]
    base, edited = (
        torch.from_numpy(np.stack([getattr(pair, name) for pair in pairs])).float() / 127 for name in ("base", "edited")
    )
    part = torch.from_numpy(np.stack([pair.changed() for pair in pairs])).float()[:, None]
    alpha_bar = build_scheduler(kind.prediction).alphas_cumprod[300]
    noise = torch.randn(edited.shape, generator=torch.Generator().manual_seed(1))
    told = torch.from_numpy(np.stack([pair.seen() for pair in pairs])).float() / 127
    seen = torch.cat([alpha_bar.sqrt() * edited + (1 - alpha_bar).sqrt() * noise, told], 1)
    with torch.no_grad():
        words = modules["text_encoder"](tokenize(tokenizer, [pair.caption for pair in pairs])).last_hidden_state
        said = base + modules["unet"](seen, torch.full((len(pairs),), 300), words).sample

    def error(picture: torch.Tensor) -> float:
        return float(((picture - edited).square() * part).sum() / part.sum())

    assert error(said) < 0.4 * error(base), "random weights are no better than a copy of the base"
    assert avg_pool2d(said, 2).shape[-1] == 64


def test_networks_that_cannot_start_this_one_are_named(tmp_path: Path) -> None:
    kind, tokenizer = GEOMETRY_WIDE, build_tokenizer(FINE.vocabulary)
    for other in (replace(kind, channels=(16, 48, 96, 160)), replace(kind, conventions={})):
        other.build_modules(tokenizer)["unet"].save_pretrained(tmp_path / "unet")
        with pytest.raises(UserError, match=r"9 inputs|8 inputs, which cannot start one of \(32, 48, 96, 160\) and 9"):
            load_start(tmp_path, kind.build_modules(tokenizer), tokenizer, kind.prediction)


@pytest.mark.parametrize("part", PARTS)
def test_every_zone_of_a_part_has_a_material(part: str) -> None:
    name = next(body for body in ("horse", "person") if suits(body, part))
    _, surface, random = made(name, 3)
    zones = PARTS[part](surface, random)
    for look in NATURAL[part]:
        assert list(look) == list(zones)
    joined, numbers = join(list(zones.values())), zone_of_piece(zones)
    pieces = pieces_of(joined)
    assert len(numbers) == pieces.max() + 1
    faces = np.cumsum([0] + [len(solid.faces) for solid in zones.values()])
    for zone in range(len(zones)):
        assert set(numbers[pieces[faces[zone] : faces[zone + 1]]]) == {zone}


def test_the_shipped_weights_are_whole_and_know_the_words() -> None:
    folder = builtin_folder(WIDE_FOLDER)
    conventions = json.loads((folder / "fd_mitsuba.json").read_text(encoding="utf-8"))
    assert conventions["vocabulary"] == FINE.word_lists
    assert json.loads((folder / "unet" / "config.json").read_text(encoding="utf-8"))["sample_size"] == 64
