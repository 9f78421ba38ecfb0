"""Several processes over the views of a step: who takes which, and what becomes of their values."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fd_mitsuba.backend import processes as module
from fd_mitsuba.backend.processes import Processes, processes
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import RunStopped, UserError
from fd_mitsuba.runs import follower
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training import step_views


def test_without_torchrun_there_is_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "4")  # as a cluster's own launcher leaves it
    processes.cache_clear()
    assert processes() == Processes() and processes().writes
    assert processes().share(6) == slice(0, 6)
    values = {"loss_sds": 0.1 + 0.2, "guidance_gradient_max": 3.0, "other": 1 / 3}
    assert processes().values_of_all(values) == values, "to the last bit"


@pytest.mark.parametrize("count", [1, 2, 4])
def test_shares_are_all_views_each_once(count: int) -> None:
    cameras = CameraBatch.around(np.arange(8) * 45.0, 10.0, 3.0, 40.0)
    own = [cameras.some(Processes(rank, count).share(8)) for rank in range(count)]
    assert np.concatenate([batch.azimuth_deg for batch in own]).tolist() == cameras.azimuth_deg.tolist()
    assert {len(batch) for batch in own} == {8 // count}


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Processes]]:
    """Two processes whose reductions are those of the given tensors, in place of torch's."""

    def make(others: dict[str, float]) -> list[Processes]:
        def reduce(tensor: torch.Tensor, how: object) -> None:
            theirs = torch.tensor([others[name] for name in sorted(others)], dtype=tensor.dtype)
            tensor.copy_(tensor + theirs if how == "sum" else torch.maximum(tensor, theirs))

        fake = SimpleNamespace(all_reduce=reduce, ReduceOp=SimpleNamespace(SUM="sum", MAX="max"))
        monkeypatch.setattr(torch, "distributed", fake)
        return [Processes(0, 2), Processes(1, 2)]

    return make


def test_values_are_those_of_all_views(two: Callable[..., list[Processes]]) -> None:
    ours = {"loss_sds": 1.0, "guidance_gradient_max": 2.0, "guidance_timestep": 100.0, "part_pixels": 5.0}
    theirs = {"loss_sds": 3.0, "guidance_gradient_max": 7.0, "guidance_timestep": 300.0, "part_pixels": 6.0}
    got = two(theirs)[0].values_of_all(ours)
    assert got == {"loss_sds": 4.0, "guidance_gradient_max": 7.0, "guidance_timestep": 200.0, "part_pixels": 11.0}
    assert list(got) == list(ours)


def test_an_end_of_another_process_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*_: object) -> None:
        raise RuntimeError("[gloo] Connection closed by peer")

    monkeypatch.setattr(torch, "distributed", SimpleNamespace(all_reduce=gone, ReduceOp=SimpleNamespace(SUM=0, MAX=1)))
    with pytest.raises(RunStopped, match="another process of the run has ended"):
        Processes(0, 2).wait()


@pytest.mark.parametrize(("views", "mosaic", "multiple"), [(4, 2, 8), (5, 1, 2), (2, 1, None), (8, 2, None)])
def test_views_that_do_not_divide(
    monkeypatch: pytest.MonkeyPatch, views: int, mosaic: int, multiple: int | None
) -> None:
    monkeypatch.setattr(step_views, "processes", lambda: Processes(1, 2))
    config, guidance = RunConfig.load(None, [f"geometry.views={views}"]), SimpleNamespace(view_grid=mosaic)
    if multiple is None:
        step_views.check_views("geometry", config, guidance)
        return
    with pytest.raises(UserError, match=f"geometry.views = {views}: 2 processes .* multiple of {multiple}, or start"):
        step_views.check_views("geometry", config, guidance)


def test_a_guidance_that_knows_of_no_others_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    follower.refuse_guidance_alone(SimpleNamespace())
    monkeypatch.setattr(follower, "processes", lambda: Processes(0, 2))
    follower.refuse_guidance_alone(None)
    with pytest.raises(UserError, match="torchrun: SimpleNamespace guides all views"):
        follower.refuse_guidance_alone(SimpleNamespace())


def test_processes_on_one_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    from fd_mitsuba.backend import threads

    assert threads._local_processes() == 1
    for name, value in {
        "WORLD_SIZE": "4",
        "LOCAL_WORLD_SIZE": "2",
        "LOCAL_RANK": "1",
        "TORCHELASTIC_RUN_ID": "x",
    }.items():
        monkeypatch.setenv(name, value)
    assert threads._local_processes() == 2 and module.started_with_others() and not module.speaks_first()
