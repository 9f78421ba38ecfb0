"""Behaviour of the geometry stage with a guidance that is known in closed form: a target picture."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import torch

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import Interrupted, RunStopped, UserError
from fd_mitsuba.extraction.pieces import label_pieces
from fd_mitsuba.guidance.interface import GuidanceResult, GuidanceViews
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.training.checkpoint import load_trained
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.training.visibility import INVISIBLE, VANISHED_AFTER, watch_visibility


class PullMask:
    """Asks for as much (sign +1) or as little (-1) of the part in the pictures as possible."""

    needs_base = False
    view_grid = 1
    normal_space = None

    def __init__(self, sign: float) -> None:
        self.sign = sign

    def picture_size(self, phase: str) -> int:
        return 24

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        return []

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: str, seed: int) -> GuidanceResult:
        return GuidanceResult(-self.sign * views.pictures[:, 3].sum())


def settings(**geometry: float) -> RunConfig:
    values = {"steps": 20, "grid_resolution": 20, "views": 2, "spp": 2, "learning_rate": 5e-3, "focal_samples": 500}
    return RunConfig.model_validate(
        {"geometry": {**values, **geometry}, "field": {"levels": 4, "finest_resolution": 16, "log2_table": 12}}
    )


@pytest.fixture
def stage(make_scene: Callable[..., Path]) -> Callable[..., GeometryStage]:
    def make(sign: float, **geometry: float) -> GeometryStage:
        return GeometryStage(load_edit_scene(make_scene()), settings(**geometry), PullMask(sign))

    return make


def test_the_loss_falls(stage: Callable[..., GeometryStage]) -> None:
    grower = stage(+1.0, lambda_focal=0.0, lambda_collision=0.0)
    first = grower.check_field(0)["volume_ratio"]
    for step in range(20):
        grower.step(step)
    assert grower.check_field(20)["volume_ratio"] > 1.2 * first


def test_the_focal_loss_keeps_the_part_in_its_region(stage: Callable[..., GeometryStage]) -> None:
    free, held = stage(+1.0, lambda_focal=0.0), stage(+1.0, lambda_focal=1e6)
    for step in range(20):
        free.step(step)
        held.step(step)

    def leaked(stage: GeometryStage) -> int:
        sdf, region = stage.extractor.part_sdf(stage.field), stage.region_sdf[stage.extractor.active_index]
        return int(((sdf > 0) & (region < -stage.config.geometry.focal_band)).sum())

    assert leaked(free) > 10 * max(leaked(held), 1)


def test_zero_weights_turn_the_work_off(stage: Callable[..., GeometryStage]) -> None:
    off = stage(+1.0, lambda_focal=0.0, lambda_collision=0.0).step(0).values
    assert "loss_focal" not in off and "loss_collision" not in off
    no_image = stage(+1.0, lambda_sds=0.0).step(0)
    assert "loss_sds" not in no_image.values and no_image.sheet() is None


@pytest.mark.usefixtures("one_thread")
def test_same_seed_same_field(stage: Callable[..., GeometryStage]) -> None:
    first, second = stage(+1.0), stage(+1.0)
    for step in range(3):
        first.step(step)
        second.step(step)
    for one, other in zip(first.field.parameters(), second.field.parameters(), strict=True):
        assert torch.equal(one, other)


class Listening(PullMask):
    """Keeps what it is shown."""

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: str, seed: int) -> GuidanceResult:
        self.seen = (tuple(map(float, views.azimuth_deg)), seed, views.pictures.detach().clone())
        return super().guide(views, step, steps_total, phase, seed)


def test_the_seed_reaches_start_field_cameras_and_guidance(make_scene: Callable[..., Path]) -> None:
    scene, seen, stages = load_edit_scene(make_scene()), [], []
    for seed in (0, 1, 2):
        config = settings(start_variety=0.6).model_copy(update={"seed": seed})
        stages.append(GeometryStage(scene, config, Listening(+1.0)))
        stages[-1].step(0)
        seen.append(stages[-1].guidance.seen)
    azimuths, noise, pictures = zip(*seen, strict=True)
    assert len(set(azimuths)) == len(set(noise)) == 3
    starts = [stage.start_sdf > 0 for stage in stages]
    assert torch.equal(starts[0], stages[0].region_sdf > 0)  # seed 0 is the region as it was drawn
    for one, other in ((0, 1), (0, 2), (1, 2)):
        overlap = (starts[one] & starts[other]).sum() / (starts[one] | starts[other]).sum()
        assert overlap < 0.9
        assert not torch.equal(pictures[one], pictures[other])
        assert not torch.equal(stages[one].field.grid.table, stages[other].field.grid.table)
    # What no picture guides, and what is cut, starts as the artist drew it.
    unguided = settings(start_variety=0.6, lambda_sds=0.0).model_copy(update={"seed": 1})
    stage = GeometryStage(scene, unguided, None)
    assert torch.equal(stage.start_sdf, stage.region_sdf)


def test_a_part_that_vanishes_stops_the_run(stage: Callable[..., GeometryStage]) -> None:
    shrinker = stage(-1.0, learning_rate=5e-2, lambda_focal=0.0)
    with pytest.raises(RunStopped, match="vanished|invisible|exploded"):
        for step in range(60):
            shrinker.step(step)
            shrinker.check_field(step)


def test_what_the_presence_loss_brings_back_may_be_gone_for_a_while(
    stage: Callable[..., GeometryStage], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Glasses are thinner than a cell. At the end there must be a part, and where nothing brings it back, always."""
    for presence, stops_at in ((20.0, (60,)), (0.0, (30, 60))):
        thin = stage(-1.0, lambda_presence=presence, steps=60)
        sdf = thin.extractor.part_sdf(thin.field)
        monkeypatch.setattr(thin.extractor, "part_sdf", MagicMock(return_value=sdf - sdf.max()))
        for step in (30, 60):
            with pytest.raises(RunStopped, match="vanished") if step in stops_at else nullcontext():
                assert thin.check_field(step) == {"volume_ratio": 0.0}


def test_the_presence_loss_leaves_no_region_empty(stage: Callable[..., GeometryStage]) -> None:
    """The pictures ask for no part at all, until nothing of it is left: without the loss, and not with it."""
    shrinker = stage(-1.0, lambda_focal=0.0, lambda_sds=1e-3, lambda_presence=1e3, presence_share=0.1)
    for step in range(60):
        shrinker.step(step)
    inside = shrinker.extractor.part_sdf(shrinker.field) > 0
    room = shrinker.field_losses.room[:, shrinker.extractor.active_index]
    assert all(0 < float(inside[row].float().mean()) < 0.5 for row in room)


def test_the_tether_loss_hangs_a_loose_piece_on_the_base(stage: Callable[..., GeometryStage]) -> None:
    """A ball above the animal's back, in its region but apart from it, and no loss that would move it but this one."""

    def pieces(weight: float) -> int:
        tied = stage(1.0, lambda_sds=0.0, lambda_focal=0.0, lambda_tether=weight, grid_resolution=40)
        grid, room = tied.grid, tied.region_sdf > 0
        high = grid.vertices[room & (tied.sdf_base < -3 * grid.spacing)]
        centre = high[high[:, 1].argmax()] - torch.tensor([0.0, 1.5 * grid.spacing, 0.0])
        tied.extractor.initial_sdf = 1.2 * grid.spacing - (grid.vertices - centre).norm(dim=1)
        for step in range(60):
            tied.step(step)
        sdf = torch.full((grid.count,), -1.0)
        sdf[tied.extractor.active_index] = tied.extractor.part_sdf(tied.field)
        solid = (torch.maximum(sdf, tied.sdf_base) > 0).view((grid.side,) * 3)
        return label_pieces(solid.numpy())[1]

    assert (pieces(0.0), pieces(100.0)) == (2, 1)


@pytest.mark.parametrize("subtracts, words", [(False, "lower geometry.lambda_volume"), (True, "what is to go")])
def test_what_to_do_about_a_part_that_nobody_sees(subtracts: bool, words: str) -> None:
    with pytest.raises(RunStopped, match=words):
        watch_visibility(torch.zeros(1, 5, 2, 2), {INVISIBLE: VANISHED_AFTER - 1}, subtracts)


def test_a_resumed_run_goes_on_counting_invisible_steps(stage: Callable[..., GeometryStage], tmp_path: Path) -> None:
    def run(first: int, resume: bool) -> list[int]:
        """The steps that were taken until the part had been invisible for too long, or a signal came."""
        blind, taken = stage(+1.0, lambda_focal=0.0, steps=60), []
        real = blind.step

        def step(number: int) -> StepRecord:
            taken.append(number)
            if number == first:
                os.kill(os.getpid(), signal.SIGINT)
            return real(number)

        blind.step = step  # type: ignore[method-assign]
        blind._render = lambda *_: torch.zeros(2, 5, 24, 24, requires_grad=True)  # type: ignore[method-assign]
        with pytest.raises(RunStopped if resume else Interrupted):
            run_stage(blind, tmp_path, resume, quiet=True, say=lambda _: None)
        return taken

    assert run(9, resume=False) == list(range(10))
    assert run(-1, resume=True) == list(range(10, VANISHED_AFTER))


def test_the_average_is_what_is_exported_and_goes_through_checkpoints(
    stage: Callable[..., GeometryStage], tmp_path: Path, one_thread: None
) -> None:
    def run(folder: Path, stop_after: int | None, resume: bool) -> GeometryStage:
        found = stage(+1.0, steps=4, average=0.5)
        real = found.step

        def step(number: int) -> StepRecord:
            if number == stop_after:
                os.kill(os.getpid(), signal.SIGINT)
            return real(number)

        found.step = step  # type: ignore[method-assign]
        with nullcontext() if stop_after is None else pytest.raises(Interrupted):
            run_stage(found, folder, resume, quiet=True, say=lambda _: None)
        return found

    whole = run(tmp_path / "whole", None, False)
    run(tmp_path / "half", 1, False)
    resumed = run(tmp_path / "half", None, True)
    again = stage(+1.0, steps=4, average=0.5)
    assert load_trained(tmp_path / "whole", again, again.config.content_hash("geometry"))
    assert whole.average is not None and whole.grown().field is whole.average.module is whole.final_field
    last = dict(whole.field.named_parameters())
    for other in (resumed, again):
        for name, averaged in other.final_field.named_parameters():
            assert torch.equal(averaged, dict(whole.final_field.named_parameters())[name])
            assert not averaged.requires_grad
    different = [name for name, value in whole.final_field.named_parameters() if not torch.equal(value, last[name])]
    assert different
    assert not torch.equal(whole.extractor(whole.field).vertices, whole.surface().vertices)


def test_a_field_that_is_not_finite_stops_the_run(stage: Callable[..., GeometryStage]) -> None:
    broken = stage(+1.0)
    with torch.no_grad():
        next(broken.field.parameters()).fill_(float("nan"))
    with pytest.raises(RunStopped, match="not finite"):
        broken.check_field(7)


def test_normals_in_another_space_than_the_models_are_refused(make_scene: Callable[..., Path]) -> None:
    guidance = PullMask(+1.0)
    guidance.normal_space = "world"
    with pytest.raises(UserError, match="geometry.normal_space=world"):
        GeometryStage(load_edit_scene(make_scene()), settings(), guidance)


def test_views_that_fill_no_mosaic_are_refused(make_scene: Callable[..., Path]) -> None:
    guidance = PullMask(+1.0)
    guidance.view_grid = 2
    with pytest.raises(UserError, match="multiple of 4"):
        GeometryStage(load_edit_scene(make_scene()), settings(views=2), guidance)
