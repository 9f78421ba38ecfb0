"""A network's samples shared out among threads: the same outputs and gradients, and never more at once than allowed."""

from __future__ import annotations

import threading
import time

import pytest
import torch

from fd_mitsuba.guidance import side_by_side
from fd_mitsuba.guidance.side_by_side import cores_for_samples, of_samples

INPUTS = torch.arange(14.0).view(7, 2).requires_grad_(), torch.arange(7)


def product(rows: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    return rows * factor[:, None]


@pytest.mark.parametrize(("most", "cores"), [(4, 1), (1, 3), (4, 2), (100, 3), (3, 9)])
def test_outputs_and_gradients_are_those_of_one_call(most: int, cores: int) -> None:
    found = of_samples(product, INPUTS, most, cores)
    assert torch.equal(found, product(*INPUTS))
    assert torch.equal(torch.autograd.grad(found.sum(), INPUTS[0])[0], torch.arange(7.0)[:, None].expand(7, 2))
    with torch.no_grad():
        assert not of_samples(product, INPUTS, most, cores).requires_grad


@pytest.mark.parametrize(("most", "cores"), [(2, 1), (5, 1), (6, 3), (3, 2), (100, 3)])
def test_rows_that_belong_together_are_never_parted(most: int, cores: int) -> None:
    seen, inputs = [], tuple(whole[:6].detach() for whole in INPUTS)

    def call(rows: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
        seen.append(factor.tolist())
        return product(rows, factor)

    assert torch.equal(of_samples(call, inputs, most, cores, together=2), product(*inputs))
    assert all(len(rows) <= most and len(rows) % 2 == 0 and rows[0] % 2 == 0 for rows in seen)
    assert sorted(sum(seen, [])) == list(range(6))


def test_no_more_samples_at_once_than_allowed() -> None:
    lock, rows, seen = threading.Lock(), [0], []

    def call(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        with lock:
            rows[0] += len(first)
            seen.append(rows[0])
        time.sleep(0.02)
        with lock:
            rows[0] -= len(first)
        return product(first, second)

    of_samples(call, INPUTS, 5, 2)
    assert 2 < max(seen) <= 5


def test_each_thread_works_alone_even_on_a_single_sample() -> None:
    seen = []

    def call(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        seen.append((torch.get_num_threads(), threading.current_thread() is threading.main_thread()))
        return product(first, second)

    one = tuple(whole[:1] for whole in INPUTS)
    of_samples(call, one, 4, 2)
    of_samples(call, INPUTS, 4, 2)
    assert set(seen) == {(1, False)}
    of_samples(call, one, 4, 1)
    assert seen[-1] == (torch.get_num_threads(), True)


def test_an_error_of_a_thread_reaches_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        of_samples(lambda *_: 1 / 0, INPUTS, 4, 2)  # type: ignore[arg-type, return-value]


def test_large_networks_and_other_devices_stay_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    network = torch.nn.Linear(3, 3)
    assert cores_for_samples(network, torch.device("cpu")) == torch.get_num_threads()
    assert cores_for_samples(network, torch.device("cuda")) == 1
    monkeypatch.setattr(side_by_side, "_SMALL", 12)
    assert cores_for_samples(network, torch.device("cpu")) == 1
