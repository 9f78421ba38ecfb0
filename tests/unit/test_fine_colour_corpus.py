"""The finer prior's colour pictures: their size, the colours that captions name, and a material for every zone."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fd_mitsuba.prior.data.catalogue import COARSE, FINE
from fd_mitsuba.prior.data.fine.captions import caption, vocabulary
from fd_mitsuba.prior.data.looks import NAMED, STYLE_OF_WORD, named_look
from fd_mitsuba.prior.judging.evaluate_colour import colours
from fd_mitsuba.prior.pictures import colour_corpus, fine_colour_corpus, light
from fd_mitsuba.prior.pictures.colour_corpus import make_colour_pairs
from fd_mitsuba.prior.pictures.corpus import SUPERSAMPLING
from fd_mitsuba.prior.pictures.fine_colour_corpus import (
    LEAST_PIXELS,
    fine_colour_caption,
    fine_part_views,
    make_fine_colour_pairs,
)
from fd_mitsuba.prior.training.kinds import APPEARANCE_FINE
from fd_mitsuba.prior.training.model import ATTENTION_CELLS, build_tokenizer
from fd_mitsuba.prior.training.pool import draw_pairs

SIDE = 2 * APPEARANCE_FINE.view_size
CAPTIONS = [
    "a cute cat that has a yellow crown, azimuth15",
    "a kitten wearing a orange crown, azimuth45 closeup",
    "a cat with a pair of red wings, azimuth45 closeup",
]
MEANS = [-58.1, -48.5, -39.9]
"""Of the coarse prior's captions and of the part's pixels in its latents, before there was a finer one of colours."""


def test_pairs_follow_from_the_seed_and_differ_only_where_the_part_is() -> None:
    first, again, other = (make_fine_colour_pairs("dragon", ["crown", None, "cape"], seed) for seed in (3, 3, 4))
    assert len(first) > 6
    for a, b in zip(first, again, strict=True):
        assert a.caption == b.caption and np.array_equal(a.edited, b.edited) and np.array_equal(a.base, b.base)
    assert not np.array_equal(first[0].edited, other[0].edited)
    for pair in first:
        assert pair.base.shape == pair.edited.shape == (4, SIDE, SIDE) and pair.base.dtype == np.int8
        assert pair.part_coverage.shape == (SIDE, SIDE) and pair.changed().sum() >= LEAST_PIXELS
        assert not (pair.base != pair.edited).any(0)[pair.part_coverage == 0].any()


def test_parts_take_the_colours_that_captions_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colour_corpus, "STYLED_SHARE", 1.0)
    seen = {}
    for style in ("red", "blue", "golden"):
        monkeypatch.setattr(colour_corpus, "random_style", lambda rng, style=style: style)
        pair = make_fine_colour_pairs("person", ["backpack"], 2)[-1]  # of one shape and light, whatever the style
        assert style in pair.caption.split()
        seen[style] = colours(pair.edited / 127)[pair.part_coverage > 250].mean(0)
    red, _, blue = np.stack([seen[style] for style in ("red", "blue", "golden")]).T
    assert red[0] > red[1] + 0.2 and blue[1] > blue[0] + 0.2
    assert seen["golden"][1] > seen["red"][1] + 0.2 and red[2] > blue[2] + 0.1


def test_a_crown_by_nature_has_a_golden_band_and_stones_of_another_colour() -> None:
    *_, view = fine_part_views("person", ["crown"], np.random.default_rng(0))
    white = light.lit_by(np.ones((light.HEIGHT, light.WIDTH, 3)))
    sapphires = FINE.natural["crown"][1]
    _, edited, coverage = view.paint(sapphires, None, white, np.random.default_rng(1))
    red, _, blue = colours(edited / 127)[coverage > 250].T
    golden, sapphire = red > blue + 0.15, blue > red + 0.15
    assert golden.sum() > 100 and sapphire.sum() > 8
    _, plain, _ = view.paint((NAMED["gold"],), None, white, np.random.default_rng(1))
    red, _, blue = colours(plain / 127)[coverage > 250].T
    assert not (blue > red).any()


def test_every_zone_in_sight_has_a_material() -> None:
    seen = {}
    for view in fine_part_views("dog", ["flower", "skateboard", "umbrella", "glasses"], np.random.default_rng(4)):
        on_part = view.hits.piece >= 0
        seen[view.part] = seen.get(view.part, set()) | set(view.zone[on_part].tolist())
        assert on_part.sum() >= LEAST_PIXELS * SUPERSAMPLING**2
    assert seen == {part: set(range(len(FINE.natural[part][0]))) for part in seen} and len(seen) == 4


def test_a_part_without_a_place_gives_no_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(fine_colour_corpus.PARTS, "crown", lambda surface, rng: {})
    assert not list(fine_part_views("ball", ["crown", None], np.random.default_rng(0)))


def test_captions_say_what_is_painted() -> None:
    rng, known, found = np.random.default_rng(0), set(vocabulary()), set()
    for body, part in (("dragon", "bat wings"), ("head", "halo"), ("horse", "horn"), ("cow", "umbrella")) * 100:
        text, adjective, material = fine_colour_caption(body, part, rng)
        assert set(text.split()) <= known and " without " not in text and " no " not in text
        before, *after = re.split(r" with | that has | wearing ", text, maxsplit=1)
        styles = [word for word in " ".join(after).split() if word in STYLE_OF_WORD]
        assert material == named_look(styles), text
        assert adjective == next((word for word in before.split() if word in STYLE_OF_WORD), None), text
        found |= {STYLE_OF_WORD[word] for word in styles}
    assert found == set(NAMED)


def test_a_given_style_is_used_as_it_is_and_none_is_the_callers_wish() -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        assert not set(caption("tree", "umbrella", rng, style="").split()[2:]) & set(STYLE_OF_WORD) - {"white", "brown"}
        text = caption("tree", "umbrella", rng, style="red")
        assert text.endswith(("a red umbrella", "a red parasol"))
        assert caption("tree", "umbrella", rng, style="orange").endswith(("an orange umbrella", "a orange parasol"))
        assert caption("tree", "umbrella", rng, style="made of wood").endswith(" made of wood")


def test_a_training_draws_pairs_of_its_catalogue() -> None:
    pairs = draw_pairs(APPEARANCE_FINE, np.random.default_rng(1))
    assert len(pairs) > 10
    assert all((p.body, p.part) not in FINE.held_out and FINE.suits(p.body, str(p.part)) for p in pairs)


def test_the_network_attends_where_the_coarse_one_does() -> None:
    unet = APPEARANCE_FINE.build_modules(build_tokenizer(FINE.vocabulary))["unet"]
    attends = ["CrossAttn" in name for name in unet.config.down_block_types]
    cells = [unet.config.sample_size >> level for level in range(len(attends)) if attends[level]]
    assert unet.config.sample_size == SIDE and tuple(cells) == ATTENTION_CELLS


def test_the_coarse_pictures_are_what_they_were() -> None:
    """Weights that were trained on them say what they were trained to say."""
    pairs = make_colour_pairs("cat", ["crown", "wings", None], 7)
    assert [pair.caption for pair in pairs[::5]] == CAPTIONS
    assert {pair.part for pair in pairs} <= set(COARSE.part_weights)
    means = [float(pair.edited[:, pair.part_coverage > 25].mean()) for pair in pairs[::5]]
    assert means == pytest.approx(MEANS, abs=0.5)
