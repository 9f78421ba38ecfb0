"""Training pairs in files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from fd_mitsuba.cli.main import main
from fd_mitsuba.errors import UserError
from fd_mitsuba.prior.data.captions import HELD_OUT
from fd_mitsuba.prior.training import dataset
from fd_mitsuba.prior.training.dataset import StoredPairs, build_data
from fd_mitsuba.prior.training.kinds import APPEARANCE, GEOMETRY
from fd_mitsuba.prior.training.pool import draw_pairs
from fd_mitsuba.prior.training.train import train


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "PAIRS_A_SHARD", 10)


def test_data_follow_from_the_seed_and_go_on_after_a_kill(small_shards: None, tmp_path: Path) -> None:
    said: list[str] = []
    made = build_data(tmp_path / "a", 25, 3, say=said.append)
    assert made["pairs"] == 25 and len(said) == 3 and made["views_per_second"] >= 3.9 * made["pairs_per_second"]
    (tmp_path / "a" / "pairs_00001.jsonl").unlink()
    assert build_data(tmp_path / "a", 25, 3)["pairs"] == 10
    assert build_data(tmp_path / "a", 25, 3)["pairs"] == 0
    build_data(tmp_path / "b", 20, 3)
    for number in range(2):
        name = f"pairs_{number:05d}"
        one, two = (np.load(tmp_path / folder / f"{name}.npz") for folder in "ab")
        assert all(np.array_equal(one[key], two[key]) for key in ("base", "edited", "changed"))
        texts = [(tmp_path / folder / f"{name}.jsonl").read_text() for folder in "ab"]
        assert texts[0] == texts[1]
        assert not {(row["body"], row["part"]) for row in map(json.loads, texts[0].splitlines())} & HELD_OUT
    with pytest.raises(UserError, match="another seed or kind"):
        build_data(tmp_path / "a", 25, 4)


def test_stored_pairs_are_those_that_were_drawn_and_can_be_trained_on(small_shards: None, tmp_path: Path) -> None:
    build_data(tmp_path / "data", 10, 5)
    drawn: list = []
    rng = np.random.default_rng([5, 0])
    while len(drawn) < 10:
        drawn += draw_pairs(GEOMETRY, rng)
    stored = StoredPairs(tmp_path / "data", GEOMETRY, seed=0)
    assert stored.captions == [pair.caption for pair in drawn[:10]] and len(stored) == 10
    for i, pair in enumerate(drawn[:10]):
        assert np.array_equal(stored.edited[i], pair.edited) and np.array_equal(stored.changed[i] > 0, pair.changed())
    base, edited, changed, captions = stored.batch(3)
    assert base.shape == (3, 5, 64, 64) and edited.shape == (3, 4, 64, 64)
    assert changed.shape == (3, 1, 64, 64) and len(captions) == 3
    assert base.abs().max() <= 1 and set(changed.unique().tolist()) <= {0.0, 1.0}
    train(tmp_path / "run", seconds=60, batch_size=2, total_steps=1, pairs=stored)
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["step"] == 1


def test_pairs_of_an_earlier_version_are_refused(small_shards: None, tmp_path: Path) -> None:
    build_data(tmp_path, 4, 5)
    shard = next(tmp_path.glob("*.npz"))
    arrays = dict(np.load(shard))
    np.savez(shard, **{**arrays, "base": arrays["base"][:, 1:]})
    with pytest.raises(UserError, match="an earlier version's, which told no region; make them anew"):
        StoredPairs(tmp_path, GEOMETRY, 0)


def test_wrong_data_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no training data there"):
        StoredPairs(tmp_path, GEOMETRY, 0)
    (tmp_path / "dataset.json").write_text('{"kind": "geometry"}')
    with pytest.raises(UserError, match="--kind geometry"):
        StoredPairs(tmp_path, APPEARANCE, 0)
    with pytest.raises(UserError, match="no shards yet"):
        StoredPairs(tmp_path, GEOMETRY, 0)
    (tmp_path / "dataset.json").write_text("{")
    with pytest.raises(UserError, match="damaged"):
        StoredPairs(tmp_path, GEOMETRY, 0)


def test_the_command_writes_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prior", "build-data", "-o", str(tmp_path), "--count", "4", "--kind", "appearance", "-t", "1"]) == 0
    assert "4 pairs made" in capsys.readouterr().out
    assert len(StoredPairs(tmp_path, APPEARANCE, 0)) == 4
    assert main(["prior", "build-data", "-o", str(tmp_path), "--count", "0"]) == 1
