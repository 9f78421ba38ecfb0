from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from fd_mitsuba.evaluation.clip import ClipJudge
from fd_mitsuba.prior.data.captions import BODY_WORDS, PART_WORDS, vocabulary
from fd_mitsuba.prior.data.catalogue import FINE
from fd_mitsuba.prior.data.clip_captions import ANY_STYLE, NO_PART, STYLES, Claim, true_of, write_caption
from fd_mitsuba.prior.judging.clip_evaluate import retrieval
from fd_mitsuba.prior.judging.evaluate import UNSEEN_SEED as PRIOR_UNSEEN_SEED
from fd_mitsuba.prior.pictures.clip_corpus import TRAINING_SEED, UNSEEN_SEED, View, make_pictures, random_pictures
from fd_mitsuba.prior.training.clip_model import build_clip_tokenizer
from fd_mitsuba.prior.training.clip_train import SEEDS_A_SHARD, SHARDS, contrastive_loss, train_evaluator
from fd_mitsuba.prior.training.pack import pack


def test_no_seed_is_shared() -> None:
    """The prior trains below 2^31 and is evaluated from 2^31 on, a few thousand seeds."""
    assert PRIOR_UNSEEN_SEED + 10**6 < TRAINING_SEED
    assert TRAINING_SEED + SHARDS * SEEDS_A_SHARD < UNSEEN_SEED


def test_captions_claim_what_is_shown_in_known_words() -> None:
    rng, known, tokenizer = np.random.default_rng(0), set(vocabulary()), build_clip_tokenizer()
    invented = 0
    for _ in range(600):
        part = int(rng.integers(-1, len(PART_WORDS)))
        style = int(rng.integers(-2, len(STYLES)))
        shown = Claim(int(rng.integers(len(BODY_WORDS))), part, style if part >= 0 else ANY_STYLE, style)
        text, claim = write_caption(shown, rng)
        assert true_of(np.array([claim]), np.array([shown])).all(), text
        unknown = [word for word in re.findall(r"[^\s,]+", text) if word not in known]
        assert len(unknown) <= 1
        invented += len(unknown)
        assert len(tokenizer(text).input_ids) <= 24
    assert 20 < invented < 120


def test_what_a_caption_is_true_of() -> None:
    horse, red, blue = 0, STYLES.index("red"), STYLES.index("blue")
    pictures = [Claim(horse, 3, red, blue), Claim(horse, 3, blue, blue), Claim(horse, NO_PART, ANY_STYLE, blue)]
    pictures.append(Claim(horse, 3, ANY_STYLE, ANY_STYLE))  # normals show no colour
    captions = [Claim(horse, 3, ANY_STYLE, ANY_STYLE), Claim(horse, 3, red, ANY_STYLE), Claim(horse, NO_PART, -1, -1)]
    expected = [[True, True, False], [True, False, False], [False, False, True], [True, True, False]]
    assert true_of(np.array(captions), np.array(pictures)).tolist() == expected


def test_contrastive_loss_by_hand() -> None:
    """Two pictures with one text, another with its own; equal similarities leave the entropies of chance."""
    matches = torch.tensor([[True, True, False], [True, True, False], [False, False, True]])
    assert contrastive_loss(torch.zeros(3, 3), matches).item() == pytest.approx(np.log(3), abs=1e-6)
    # Far apart, what is left is the choice between two equally good partners: ln 2 for two of the three.
    apart = 100 * matches.float()
    assert contrastive_loss(apart, matches).item() == pytest.approx(2 / 3 * np.log(2), abs=1e-6)


def test_pictures_are_the_seeds_and_in_pairs() -> None:
    first, again = random_pictures(UNSEEN_SEED + 5), random_pictures(UNSEEN_SEED + 5)
    assert len(first) == len(again) and all((a.pixels == b.pixels).all() for a, b in zip(first, again, strict=True))
    for normals, lit in zip(first[::2], first[1::2], strict=True):
        assert normals.shown[:2] == lit.shown[:2] and normals.shown.part_style == ANY_STYLE
        assert (normals.part_share == lit.part_share).all()
        empty = normals.body_share == 0
        patches = normals.pixels.reshape(8, 8, 8, 8, 3).swapaxes(1, 2)
        assert empty.any() and not patches[empty].any()


def test_the_finer_words_have_pictures_and_captions_too() -> None:
    names, rng = list(FINE.part_weights), np.random.default_rng(0)
    view = View.at(0.6, 0.3, 3.4, 1.4, np.zeros(3))
    pictures = make_pictures("person", ["glasses", "backpack"], UNSEEN_SEED + 9, [view], catalogue=FINE)
    shown = {names[p.shown.part] for p in pictures if p.shown.part != NO_PART}
    assert "glasses" in shown and len(pictures) >= 4
    for picture in pictures:
        text, claim = write_caption(picture.shown, rng, FINE)
        assert true_of(np.array([claim]), np.array([picture.shown])).all(), text


def test_training_learns_resumes_and_packs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SHARDS", 1), ("EVEN_SHARDS", 1), ("SETTLING", 0.25)):
        monkeypatch.setattr(f"fd_mitsuba.prior.training.clip_train.{name}", value)
    monkeypatch.setattr("fd_mitsuba.prior.training.clip_train.SEEDS_A_SHARD", 2)
    for steps in (4, 8):
        train_evaluator(tmp_path / "run", 100, total_steps=steps, batch_size=12, data=tmp_path / "data", least_shards=1)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["step"] == 8 and state["began"] == 6
    assert len(list((tmp_path / "data" / "even").glob("*.npz"))) == 1
    pack(tmp_path / "run" / "checkpoint.pt", tmp_path / "packed")
    judge = ClipJudge.load(str(tmp_path / "packed"))
    assert judge.geometry_pictures == "normals" and judge.texts(["a horse"]).isfinite().all()


def test_the_shipped_evaluator_finds_parts_on_unseen_bodies() -> None:
    """Chance is 1 in 16 for the part and 1 in 18 for the body; `docs/prior.md` has the figures over all pairs."""
    bodies, parts = ["horse", "cat", "snowman", "mug"], ["wings", "crown", "pointed hat", "handle", "skateboard"]
    for lit, least_part, least_body in ((False, 0.7, 0.7), (True, 0.45, 0.5)):
        found = retrieval(ClipJudge.load(), bodies, parts, lit=lit, seed=77)
        assert np.mean([row.ring for row in found.values()]) >= least_part
        assert np.mean([row.body for row in found.values()]) >= least_body
