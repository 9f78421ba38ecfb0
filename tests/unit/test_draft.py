"""Which steps are drafted, from where, and what they begin with and follow; with a drafter that draws a square."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from fd_mitsuba.config import RunConfig
from fd_mitsuba.guidance.interface import Drawn, GuidanceResult, GuidanceViews
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.training.checkpoint import load_newest
from fd_mitsuba.training.draft import draft_views
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import run_stage

FOCUS = np.array([0.0, 0.5, 0.1]), 0.3


class Drawing:
    """Draws a part in the views, by default in the middle of each; asks for more of it; keeps what it is asked."""

    def __init__(self, rows: tuple[slice, ...]) -> None:
        self.drawn_for: list[tuple[GuidanceViews, int]] = []
        self.followed: list[slice] = []
        self.rows = rows

    def draw(self, views: GuidanceViews, seed: int) -> Drawn:
        self.drawn_for.append((views, seed))
        part = torch.zeros(len(views.pictures), 32, 32)
        for view in range(len(part)):
            part[view, self.rows[view % len(self.rows)], 8:24] = 1.0
        return Drawn(torch.zeros(len(part) // 4, 4, 64, 64), part, 0.5)

    def guide(self, pictures: torch.Tensor, drawn: Drawn, chosen: slice) -> GuidanceResult:
        self.followed.append(chosen)
        return GuidanceResult(-pictures[:, 3].sum(), {"drafted": 1.0})


class DrawingGuidance:
    """Of mosaics of four views; asks for less of the part, where its drafter asks for more."""

    needs_base = False
    view_grid = 2
    normal_space = None

    def __init__(self, *rows: slice) -> None:
        self.drafter, self.steps, self.drafted = Drawing(rows or (slice(8, 24),)), [], []

    def picture_size(self, phase: str) -> int:
        return 24

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        return []

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: str, seed: int) -> GuidanceResult:
        self.steps.append(step)
        self.drafted.append(views.drafted)
        return GuidanceResult(views.pictures[:, 3].sum())


def settings(**geometry: float) -> RunConfig:
    values = {"steps": 10, "grid_resolution": 20, "views": 4, "spp": 2, "learning_rate": 5e-3, "focal_samples": 500}
    return RunConfig.model_validate(
        {
            "geometry": {**values, "coarse_fraction": 1.0, "draft_fraction": 0.4, **geometry},
            "field": {"levels": 4, "finest_resolution": 16, "log2_table": 12},
            "output": {"checkpoint_every": 2, "sheet_every": 0},
        }
    )


@pytest.fixture
def scene(make_scene: Callable[..., Path]) -> EditScene:
    return load_edit_scene(make_scene())


def test_the_views_are_close_and_all_around() -> None:
    settings = RunConfig.load("quick").cameras
    views = draft_views(settings, 8, 4, FOCUS)
    assert np.allclose(views.target, FOCUS[0]) and np.allclose(views.elevation_deg, np.mean(settings.elevation_deg))
    assert np.allclose(views.azimuth_deg, [0, 90, 180, 270, 45, 135, 225, 315])
    edge = np.tan(np.radians(views.fov_deg[0]) / 2) * np.sqrt(settings.radius**2 - (1.4 * FOCUS[1]) ** 2)
    assert edge == pytest.approx(1.4 * FOCUS[1], rel=1e-3)  # a ball of 1.4 radii touches the picture's border
    assert draft_views(settings, 4, 4, (FOCUS[0], 2.0)).fov_deg.max() <= np.mean(settings.fov_deg)


def test_a_stage_drafts_first_and_is_guided_then(scene: EditScene) -> None:
    guidance, free = DrawingGuidance(), {"lambda_focal": 0.0, "lambda_collision": 0.0}
    stage = GeometryStage(scene, settings(steps=20, draft_fraction=0.2, **free), guidance)
    stage.drafts.begin(stage.field)
    before = stage.check_field(0)["volume_ratio"]
    records = [stage.step(step).values for step in range(4)]
    drafted = stage.check_field(4)["volume_ratio"]
    assert drafted > 1.02 * before and all("drafted" in values for values in records) and guidance.steps == []
    for step in range(4, 20):
        assert "drafted" not in stage.step(step).values
    assert stage.check_field(20)["volume_ratio"] < drafted
    assert guidance.steps == list(range(4, 20)) and all(guidance.drafted)
    assert len(guidance.drafter.drawn_for) == 1 and guidance.drafter.followed == [slice(0, 1)] * 4


def test_the_field_begins_as_the_hull_within_the_regions(scene: EditScene) -> None:
    """Everything in the middle half of all pictures, which are 1.4 times as wide as the regions."""
    stage = GeometryStage(scene, settings(), DrawingGuidance())
    error = stage.drafts.begin(stage.field)
    hull = stage.drafts.parts[0].hull[stage.extractor.active_index]
    sdf, region = stage.extractor.part_sdf(stage.field), stage.region_sdf[stage.extractor.active_index]
    deep = hull.abs() > stage.grid.spacing
    assert error < 0.3 and ((sdf > 0) == (hull > 0))[deep].float().mean() > 0.97
    assert not (hull > region).any() and (hull > 0).sum() < 0.9 * (region > 0).sum()
    positions = stage.grid.vertices[stage.extractor.active_index][hull > 0].numpy()
    assert np.linalg.norm(positions - stage.foci[0][0], axis=1).max() < 1.1 * 1.4 * stage.foci[0][1] / 2 * np.sqrt(3)


NOTHING, TOP, BOTTOM = slice(0, 0), slice(4, 12), slice(20, 28)


@pytest.mark.parametrize("rows", [(NOTHING,), (TOP, BOTTOM, TOP, BOTTOM)], ids=["nothing", "another part in each view"])
def test_where_no_one_part_is_drawn_every_step_is_guided_as_if_nothing_was(
    scene: EditScene, rows: tuple[slice, ...]
) -> None:
    guidance = DrawingGuidance(*rows)
    stage = GeometryStage(scene, settings(), guidance)
    assert stage.drafts.begin(stage.field) is None and not stage.drafts.lead
    plain = GeometryStage(scene, settings(draft_fraction=0.0), DrawingGuidance())
    assert np.array_equal(stage.cameras(0)[0].azimuth_deg, plain.cameras(0)[0].azimuth_deg)  # not always the same ones
    stage.step(0), plain.step(0)
    assert guidance.steps == [0] and guidance.drafted == [False] and guidance.drafter.followed == []
    for one, other in zip(stage.field.parameters(), plain.field.parameters(), strict=True):
        assert torch.equal(one, other)


def test_several_pictures_a_step_and_a_share_of_the_views(scene: EditScene) -> None:
    guidance = DrawingGuidance()
    draft = GeometryStage(scene, settings(views=8), guidance).drafts.parts[0]
    draft.guide(torch.zeros(8, 5, 24, 24), 0)
    draft.guide(torch.zeros(4, 5, 24, 24), 4)  # the second of two processes
    assert guidance.drafter.followed == [slice(0, 2), slice(1, 2)]


def test_without_a_drafter_and_for_cuts_nothing_is_drafted(scene: EditScene) -> None:
    for guidance, share in ((DrawingGuidance(), 0.0), (None, 0.4)):
        assert GeometryStage(scene, settings(draft_fraction=share), guidance).drafts is None
    blind = DrawingGuidance()
    blind.drafter = None
    stage = GeometryStage(scene, settings(), blind)
    stage.step(0)
    assert stage.drafts is None and blind.drafted == [False]


def test_seeds_draw_others_parts(scene: EditScene) -> None:
    asked = []
    for seed in (0, 0, 1):
        guidance = DrawingGuidance()
        GeometryStage(scene, settings().model_copy(update={"seed": seed}), guidance).step(0)
        asked.append(guidance.drafter.drawn_for[0][1])
    assert asked[0] == asked[1] != asked[2]


@pytest.mark.usefixtures("one_thread")
def test_a_run_resumed_among_drafted_steps_ends_the_same(scene: EditScene, tmp_path: Path) -> None:
    config = settings(steps=6, draft_fraction=0.7)

    class Killed(Exception):
        pass

    def kill(update: object) -> None:
        if update.step == 3:
            raise Killed

    whole = GeometryStage(scene, config, DrawingGuidance())
    run_stage(whole, tmp_path / "whole", quiet=True)
    with pytest.raises(Killed):
        run_stage(GeometryStage(scene, config, DrawingGuidance()), tmp_path / "killed", quiet=True, on_step=kill)
    again = GeometryStage(scene, config, DrawingGuidance())
    done, _ = load_newest(tmp_path / "killed/checkpoints", "geometry", config.content_hash("geometry"), again.field,
                          again.optimiser)  # fmt: skip
    assert done == 2
    run_stage(again, tmp_path / "killed", resume=True, quiet=True, say=lambda line: None)
    for one, other in zip(whole.field.parameters(), again.field.parameters(), strict=True):
        assert torch.equal(one, other)


HAT_AND_TAIL = "".join(
    f'<shape type="focal_region" id="{name}"><string name="part" value="{name}"/><transform name="to_world">'
    f'<scale value="0.25"/><translate y="{y}" z="{z}"/></transform></shape>'
    for name, y, z in (("hat", 0.55, 0.5), ("tail", 0.1, -0.6))
)


def test_parts_are_drafted_and_looked_at_in_turn(make_scene: Callable[..., Path]) -> None:
    scene = load_edit_scene(make_scene(region=HAT_AND_TAIL))
    guidance = DrawingGuidance()
    config = settings(steps=6, draft_fraction=0.7)
    config = config.model_copy(update={"cameras": config.cameras.model_copy(update={"focus_fraction": 1.0})})
    stage = GeometryStage(scene, config, guidance)
    centres = [region.to_canonical[:3, 3] for region in scene.regions]
    for step in range(6):  # four that are drafted, two that are guided
        cameras, closeup = stage.cameras(step)
        assert closeup and np.abs(cameras.target - centres[step % 2]).max() < 1.5 * stage.grid.spacing
    assert stage.drafts.begin(stage.field) < 0.3
    (_, first), (_, second) = guidance.drafter.drawn_for
    assert first != second
    sdf = stage.extractor.part_sdf(stage.field)
    points = stage.grid.vertices[stage.extractor.active_index][sdf > 0].numpy()
    held = [np.linalg.norm(points - centre, axis=1) < 0.3 * scene.frame.scale for centre in centres]
    assert held[0].any() and held[1].any() and (held[0] | held[1]).all()
    guidance.drafter.rows = (NOTHING,)
    for step in range(6):
        stage.step(step)
    assert guidance.steps == [4, 5]


def test_a_part_of_which_nothing_is_drawn_is_guided_from_the_first_step(make_scene: Callable[..., Path]) -> None:
    scene = load_edit_scene(make_scene(region=HAT_AND_TAIL))
    guidance = DrawingGuidance()
    stage = GeometryStage(scene, settings(steps=4, draft_fraction=1.0), guidance)
    assert stage.drafts.parts[0].leads
    guidance.drafter.rows = (NOTHING,)
    for step in range(4):
        stage.step(step)
    assert guidance.steps == [1, 3] and guidance.drafted == [True, True]
