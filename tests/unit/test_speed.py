"""The measured speed of a core, against a product of matrices of another library, and what it leaves behind."""

from __future__ import annotations

import time

import numpy as np
import torch

from fd_mitsuba.backend.speed import processor_speed


def test_it_is_of_the_order_of_what_numpy_reaches() -> None:
    threads = torch.get_num_threads()
    found = processor_speed()
    assert torch.get_num_threads() == threads and processor_speed() == found  # once a process
    matrix = np.random.default_rng(0).random((512, 512), dtype=np.float32)
    seconds = []
    for _ in range(15):
        start = time.perf_counter()
        _ = matrix @ matrix
        seconds.append(time.perf_counter() - start)
    assert 0.05 < found * min(seconds) / (2 * 512**3) < 20
