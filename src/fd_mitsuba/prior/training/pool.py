"""Where a training's batches come from: the most recent of freshly rendered pairs, made here or by worker processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import queue
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch

from fd_mitsuba.errors import UserError
from fd_mitsuba.prior.pictures.corpus import Pair
from fd_mitsuba.prior.training.kinds import Kind, kind_named

Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, list[str]]
_QUEUED = 64
_PATIENCE_SECONDS = 120.0


def draw_pairs(kind: Kind, rng: np.random.Generator) -> Sequence[Pair]:
    """The pairs of one random body with four of its parts, and in half of the cases of the body alone.

    None is one that the catalogue leaves out, and none has a part that the views hardly show: it would teach that
    the word means nothing.
    """
    body, parts = kind.catalogue.draw(rng)
    pairs = kind.make_pairs(body, parts, int(rng.integers(2**31)))
    return [pair for pair in pairs if pair.part is None or pair.shows_part()]


class Pairs(Protocol):
    """Where the training's batches come from: rendered as they are needed (`Pool`), or `dataset.StoredPairs`."""

    def refresh(self, count: int) -> None:
        """Bring `count` more pairs in, if that is how it works."""

    def batch(self, size: int) -> Batch:
        """What the network sees (size, C, L, L), edited latents (size, 4, L, L), the part's pixels (size, 1, L, L), and
        captions; values in [-1, 1].
        """
        ...


class Pool:
    """The most recent pairs; every call to `refresh` renders one more body with a few of its parts."""

    def __init__(self, kind: Kind, seed: int, capacity: int = 6000) -> None:
        self._kind, self._owed = kind, 0
        self._rng = np.random.default_rng(seed)
        self._pairs: deque[Pair] = deque(maxlen=capacity)

    def refresh(self, count: int) -> None:
        """Render until `count` more pairs are there; what a body gives beyond that counts for the next call."""
        self._owed += count
        while self._owed > 0:
            made = draw_pairs(self._kind, self._rng)
            self._pairs.extend(made)
            self._owed -= len(made)

    def batch(self, size: int) -> Batch:
        """As `Pairs.batch`."""
        chosen = [self._pairs[i] for i in self._rng.integers(len(self._pairs), size=size)]
        base = torch.from_numpy(np.stack([p.seen() for p in chosen])).float() / 127
        edited = torch.from_numpy(np.stack([p.edited for p in chosen])).float() / 127
        changed = torch.from_numpy(np.stack([p.changed() for p in chosen])).float()[:, None]
        return base, edited, changed, [p.caption for p in chosen]


class WorkerPool:
    """A pool that processes fill beside the training, as fast as they can: a GPU must not wait for pictures.

    Which pairs are there at a step depends on the machine, so that only a training with `Pool` follows from its seed.

    Args:
        workers: processes; each renders on one core, from seeds of its own.
        capacity: pairs that are kept, the most recent ones.
        device: where they are kept and batches come from.
    """

    def __init__(
        self, kind: Kind, seed: int, workers: int, capacity: int = 20000, device: torch.device | str = "cpu"
    ) -> None:
        side = 2 * kind.view_size
        self._rng, self._made, self._device = np.random.default_rng(seed), 0, device
        self._base, self._edited = (
            torch.empty((capacity, channels, side, side), dtype=torch.int8, device=device)
            for channels in (kind.input_channels - 4, 4)
        )
        self._changed = torch.empty((capacity, 1, side, side), dtype=torch.bool, device=device)
        self._captions = [""] * capacity
        context = multiprocessing.get_context("spawn")  # a forked process would share Mitsuba's threads
        self._queue = context.Queue(_QUEUED)
        self._processes = [
            context.Process(target=_fill, args=(self._queue, kind.name, seed, number), daemon=True)
            for number in range(workers)
        ]
        for process in self._processes:
            process.start()

    def refresh(self, count: int) -> None:
        """Take in what the workers have made; waits only while there are less than `count` pairs in all.

        Raises:
            UserError: the workers have stopped.
        """
        for _ in range(_QUEUED):
            if not self._take(0.0):
                break
        while self._made < count:
            self._take(_PATIENCE_SECONDS)

    def _take(self, seconds: float) -> bool:
        """Add what a worker has made, if there is something within that time; whether there was."""
        with contextlib.suppress(queue.Empty):
            self._store(*self._queue.get(timeout=seconds))
            return True
        if not any(process.is_alive() for process in self._processes):
            raise UserError("--workers: the processes that render pictures have stopped; see above")
        return False

    def _store(self, base: np.ndarray, edited: np.ndarray, changed: np.ndarray, captions: list[str]) -> None:
        places = (self._made + np.arange(len(captions))) % len(self._captions)
        rows = torch.from_numpy(places).to(self._device)
        for kept, new in ((self._base, base), (self._edited, edited), (self._changed, changed[:, None])):
            kept[rows] = torch.from_numpy(new).to(self._device)
        for place, text in zip(places, captions, strict=True):
            self._captions[place] = text
        self._made += len(captions)

    def batch(self, size: int) -> Batch:
        """As `Pairs.batch`, on the pool's device."""
        chosen = self._rng.integers(min(self._made, len(self._captions)), size=size)
        rows = torch.from_numpy(chosen).to(self._device)
        base, edited = self._base[rows].float() / 127, self._edited[rows].float() / 127
        return base, edited, self._changed[rows].float(), [self._captions[i] for i in chosen]

    def close(self) -> None:
        """End the workers."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()


def _fill(pairs: multiprocessing.Queue, kind_name: str, seed: int, number: int) -> None:
    from fd_mitsuba.backend.threads import share_cores

    share_cores(1)
    kind, rng = kind_named(kind_name), np.random.default_rng([seed, number, 1])
    while True:
        made = draw_pairs(kind, rng)
        if made:
            # Arrays of all at once: thousands of small objects a second would keep the training busy with unpacking.
            base, edited, changed = zip(*((pair.seen(), pair.edited, pair.changed()) for pair in made), strict=True)
            pairs.put((np.stack(base), np.stack(edited), np.stack(changed), [pair.caption for pair in made]))
