from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import pytest
import torch

from fd_mitsuba.backend import threads


def test_the_network_gets_the_cores_and_gives_them_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = torch.get_num_threads()
    monkeypatch.setattr(threads, "_cores", None)
    with threads.network_threads():
        assert torch.get_num_threads() == before  # nobody shared the cores yet
    monkeypatch.setattr(threads, "_cores", before + 1)
    with pytest.raises(KeyError), threads.network_threads():
        assert torch.get_num_threads() == before + 1
        raise KeyError
    assert torch.get_num_threads() == before


def test_pictures_get_the_cores_and_give_them_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = dr.thread_count()
    monkeypatch.setattr(threads, "_cores", None)
    with threads.rendering_threads():
        assert dr.thread_count() == before
    monkeypatch.setattr(threads, "_cores", before + 1)
    with pytest.raises(KeyError), threads.rendering_threads():
        assert dr.thread_count() == before + 1
        raise KeyError
    assert dr.thread_count() == before


def test_steps_with_large_pictures_get_all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    def counts() -> tuple[int, int]:
        return dr.thread_count(), torch.get_num_threads()

    before = counts()
    monkeypatch.setattr(threads, "_cores", max(before) + 1)
    with threads.step_threads(4 * 256**2 * 2):
        assert counts() == before, "the built-in prior's refined steps"
    with threads.step_threads(4 * 512**2 * 2):
        assert counts() == (max(before) + 1,) * 2
    assert counts() == before


def test_the_renderer_shares_only_where_there_are_cores_to_spare() -> None:
    assert [threads.renderer_threads(cores) for cores in (1, 2, 3, 8)] == [1, 1, 2, 7]


@pytest.mark.parametrize(("given", "network", "renderer"), [(1, 1, 1), (3, 3, 2)])
def test_a_process_starts_with_the_shares(given: int, network: int, renderer: int) -> None:
    script = f"""
import sys
from pathlib import Path
from fd_mitsuba.backend.threads import network_threads, share_cores
assert "torch" not in sys.modules
share_cores({given})
import os, drjit, torch
with network_threads():
    inside = torch.get_num_threads()
print(os.environ["OMP_WAIT_POLICY"], torch.get_num_threads(), inside, drjit.thread_count())
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("OMP_WAIT_POLICY", None)
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["PASSIVE", "1", str(network), str(renderer)], done.stderr


def test_lone_threads_stay_alone_when_another_thread_takes_more() -> None:
    before = torch.get_num_threads()
    try:
        with threads.lone_threads(1) as lone:
            lone.submit(int).result()  # the thread is there, but torch has done nothing in it yet
            torch.set_num_threads(before + 1)
            assert lone.submit(torch.get_num_threads).result() == 1
            assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)


def test_code_between_our_calls_has_its_own_threads(tmp_path: Path) -> None:
    """Mitsuba waits forever for an EXR with one thread of Dr.Jit's, which is what a run takes on two cores."""
    script = f"""
import numpy as np
from fd_mitsuba.backend.threads import own_threads
counts = []
with own_threads(1):
    import drjit as dr, mitsuba as mi, torch
    counts += [dr.thread_count(), torch.get_num_threads()]
mi.Bitmap(np.full((64, 64, 3), 0.5, np.float32)).write({str(tmp_path / "a.exr")!r})
dr.set_thread_count(3)
torch.set_num_threads(4)
with own_threads():
    counts += [dr.thread_count(), torch.get_num_threads()]
counts += [dr.thread_count(), torch.get_num_threads()]
print(*counts, float(np.array(mi.Bitmap({str(tmp_path / "a.exr")!r})).max()))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["1", "1", "1", "1", "3", "4", "0.5"], done.stderr
