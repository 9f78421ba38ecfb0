"""Training pairs in files: made ahead, looked at, shared, and read again by `prior train --data`.

A folder holds `dataset.json` and shards `pairs_00000.npz` (base: (N, C, L, L) int8 in units of 1/127, its latents
after the region where the kind is told it; edited: (N, 4, L, L) likewise; changed: (N, L, L / 8) uint8, the part's
pixels packed by `numpy.packbits`) with `pairs_00000.jsonl` beside them: a line a pair with its caption, body, part,
first azimuth, whether it is a close-up and whether the part is taken away.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.prior.training.kinds import GEOMETRY, Kind
from fd_mitsuba.prior.training.pool import draw_pairs

PAIRS_A_SHARD = 256
VIEWS_A_PAIR = 4
_RECORD = "dataset.json"


def build_data(
    folder: Path, count: int, seed: int, kind: Kind = GEOMETRY, say: Callable[[str], None] = lambda line: None
) -> dict[str, float]:
    """Write `count` pairs; shards that are there are kept, so that a killed call goes on where it was.

    Shard k depends on (kind, seed, k) alone, and the last one may be short.

    Args:
        say: takes a line a shard.

    Returns:
        `pairs` that were made now, `seconds`, `pairs_per_second` (mosaics) and `views_per_second` (image pairs).

    Raises:
        UserError: the folder holds data of another seed or kind.
    """
    if count < 1 or seed < 0:
        raise UserError(f"--count {count}, --seed {seed}: count must be at least 1 and seed at least 0")
    record = {"kind": kind.name, "seed": seed, "pairs_a_shard": PAIRS_A_SHARD}
    if (folder / _RECORD).is_file() and read_record(folder) != record:
        raise UserError(f"{folder / _RECORD}: holds data of another seed or kind; give another folder by -o")
    write_atomically(folder / _RECORD, (json.dumps(record) + "\n").encode())
    started, made = time.monotonic(), 0
    for number in range(-(-count // PAIRS_A_SHARD)):
        size = min(PAIRS_A_SHARD, count - number * PAIRS_A_SHARD)
        if _stored(folder, number) == size:
            continue
        _write_shard(folder, number, size, seed, kind)
        made += size
        say(f"shard {number}: {made / (time.monotonic() - started):.0f} pairs/s")
    seconds = time.monotonic() - started
    rate = made / seconds if made else 0.0
    return {
        "pairs": made,
        "seconds": round(seconds, 1),
        "pairs_per_second": round(rate, 1),
        "views_per_second": round(VIEWS_A_PAIR * rate, 1),
    }


def read_record(folder: Path) -> dict:
    """What `dataset.json` says. Raises UserError where there is none that can be read."""
    try:
        record = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
    except OSError:
        raise UserError(f"{folder}: no training data there; make some with fd_mitsuba prior build-data") from None
    except ValueError:
        raise UserError(f"{folder / _RECORD}: is damaged; make the data anew") from None
    return record


class StoredPairs:
    """All pairs of a folder in memory (33 kB each, 131 kB of the finer prior), drawn at random.

    Raises:
        UserError: no data there, or of another kind of prior.
    """

    def __init__(self, folder: Path, kind: Kind, seed: int) -> None:
        record = read_record(folder)
        if record["kind"] != kind.name:
            raise UserError(f"{folder}: its data are for --kind {record['kind']}")
        shards = sorted(path for path in folder.glob("pairs_*.npz") if path.with_suffix(".jsonl").is_file())
        if not shards:
            raise UserError(f"{folder}: holds no shards yet; make some with fd_mitsuba prior build-data")
        loaded = [np.load(path) for path in shards]
        self.base, self.edited, packed = (
            np.concatenate([shard[name] for shard in loaded]) for name in ("base", "edited", "changed")
        )
        if self.base.shape[1] != kind.input_channels - 4:
            raise UserError(f"{folder}: its pairs are an earlier version's, which told no region; make them anew")
        self.changed = np.unpackbits(packed, axis=-1)
        lines = [line for path in shards for line in path.with_suffix(".jsonl").read_text("utf-8").splitlines()]
        self.captions = [json.loads(line)["caption"] for line in lines]
        self._rng = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self.captions)

    def refresh(self, count: int) -> None:
        """Does nothing: what is stored is all there is."""

    def batch(self, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, list[str]]:
        """As `train.Pairs.batch`."""
        chosen = self._rng.integers(len(self), size=size)
        base, edited = (torch.from_numpy(data[chosen]).float() / 127 for data in (self.base, self.edited))
        changed = torch.from_numpy(self.changed[chosen]).float()[:, None]
        return base, edited, changed, [self.captions[i] for i in chosen]


def _write_shard(folder: Path, number: int, size: int, seed: int, kind: Kind) -> None:
    rng = np.random.default_rng([seed, number])
    pairs: list = []
    while len(pairs) < size:
        pairs += draw_pairs(kind, rng)
    pairs = pairs[:size]
    data = io.BytesIO()
    np.savez_compressed(
        data,
        base=np.stack([pair.seen() for pair in pairs]),
        edited=np.stack([pair.edited for pair in pairs]),
        changed=np.packbits(np.stack([pair.changed() for pair in pairs]), axis=-1),
    )
    lines = [
        {
            "caption": pair.caption,
            "body": pair.body,
            "part": pair.part,
            "azimuth_deg": round(pair.azimuth_deg, 3),
            "closeup": pair.closeup,
            "removed": pair.removed,
        }
        for pair in pairs
    ]
    path = _shard(folder, number)
    write_atomically(path, data.getvalue())
    # The captions come last: a shard without them is not whole.
    text = "".join(json.dumps(line) + "\n" for line in lines)
    write_atomically(path.with_suffix(".jsonl"), text.encode())


def _shard(folder: Path, number: int) -> Path:
    return folder / f"pairs_{number:05d}.npz"


def _stored(folder: Path, number: int) -> int:
    """How many pairs of a shard are there."""
    captions = _shard(folder, number).with_suffix(".jsonl")
    if not captions.is_file() or not _shard(folder, number).is_file():
        return 0
    return len(captions.read_text(encoding="utf-8").splitlines())
