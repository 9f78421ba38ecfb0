"""Whole files, whoever writes them at the same time."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fd_mitsuba.io.atomic import is_litter, write_atomically


def test_two_threads_write_one_file(tmp_path: Path) -> None:
    path = tmp_path / "studio.json"
    texts = [bytes([65 + number]) * 20_000 for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(10):
            list(pool.map(lambda text: write_atomically(path, text), texts))
            assert path.read_bytes() in texts
    assert not [left for left in tmp_path.iterdir() if is_litter(left)]
