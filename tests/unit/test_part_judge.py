"""The protocol that judges the shape prior: pictures, counting, and the table of pairs for three dimensions."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.before_and_after import judged_views
from fd_mitsuba.evaluation.part_judge import (
    CAMERA_RADIUS,
    CLASSES_NAME,
    JUDGE_FOLDER,
    LEAST_PIXELS,
    NOTHING,
    PartNetwork,
    changed_pixels,
    load_judge,
    save_judge,
)
from fd_mitsuba.guidance.builtin import builtin_folder, write_hashes
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.catalogue import COARSE
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.data.primitives import join
from fd_mitsuba.prior.judging.body_namer import BodyNamer
from fd_mitsuba.prior.judging.evaluate_parts import evaluate_parts, judge_sample, summary
from fd_mitsuba.prior.judging.single_views import seen_by_judge, views_of
from fd_mitsuba.prior.pictures.corpus import MosaicCamera, Pair, RayCaster, make_pairs, shade
from fd_mitsuba.prior.pictures.fine_corpus import make_fine_pairs
from fd_mitsuba.prior.pictures.part_corpus import SEEDS_APART, UNSEEN_SEED, make_views
from fd_mitsuba.prior.training.kinds import GEOMETRY_FINE
from fd_mitsuba.prior.training.part_judge_train import JUDGE_KINDS, JudgeKind, judge_kind, measure, train_part_judge
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.region_place import share_in_grid

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
CHECKOUT_CLASSIFIER = BENCHMARKS / "part_classifier"


def benchmark(name: str) -> ModuleType:
    """A module of the benchmarks, which are no package."""
    for folder in (str(BENCHMARKS), str((BENCHMARKS / name).parent)):
        if folder not in sys.path:
            sys.path.append(folder)
    specification = importlib.util.spec_from_file_location(Path(name).name, BENCHMARKS / f"{name}.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[Path(name).name] = module
    specification.loader.exec_module(module)
    return module


class SaysPart:
    """A judge that takes any change for wings."""

    classes = (*PARTS, "none")

    def __call__(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        changed = changed_pixels(before, after) >= LEAST_PIXELS
        said = np.zeros((len(before), len(self.classes)), np.float32)
        said[np.arange(len(before)), np.where(changed, 0, len(PARTS))] = 1
        return said


class SeesBrightness:
    """A judge to whom black pictures are balls and all others persons."""

    def texts(self, texts: list[str]) -> torch.Tensor:
        places = {"ball": (1.0, 0.0), "person": (0.0, 1.0)}
        return torch.tensor([places.get(text.split()[1], (-1.0, -1.0)) for text in texts])

    def images(self, pictures: torch.Tensor) -> torch.Tensor:
        bright = (pictures.amax((1, 2, 3)) > 0.1).float()
        return torch.stack([1 - bright, bright], dim=1)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return make_pairs("person", ["wings", "tail", None], 2**31 + 5)


def test_views_of_takes_mosaics_apart_as_the_guidance_puts_them_together() -> None:
    views = np.random.default_rng(0).random((8, 4, 6, 6)).astype(np.float32)
    assert np.array_equal(views_of(tile_views(torch.from_numpy(views), 2).numpy()), views)


def test_changed_pixels_count_and_fade() -> None:
    before = np.zeros((2, 4, 8, 8))
    after = before.copy()
    after[1, 2, 3, 4:7] = (0.3, 2.0, -0.15)
    assert changed_pixels(before, after) == pytest.approx([0, 2.5])


def test_a_sample_like_the_truth_is_found_and_one_like_the_base_is_not(pairs: list[Pair]) -> None:
    wings = next(pair for pair in pairs if pair.part == "wings")
    base, truth = wings.base / np.float32(127), wings.edited / np.float32(127)
    good, lazy = (judge_sample(wings, picture, SaysPart()) for picture in (truth, base))
    assert (good.found, good.views_found, good.body_kept, good.unchanged) == (True, 1.0, True, False)
    assert (lazy.found, lazy.views_found, lazy.body_kept, lazy.unchanged) == (False, 0.0, True, True)
    assert good.found_in_truth and lazy.found_in_truth
    spoilt = judge_sample(wings, -base, SaysPart())
    assert not spoilt.body_kept and not spoilt.shape_kept
    shifted = judge_sample(wings, truth + np.float32(0.25), SaysPart())
    assert shifted.shape_kept and not shifted.body_kept and shifted.body_error == pytest.approx(0.25, abs=0.06)
    smaller, elsewhere = (replace(wings, edited=other) for other in (wings.base, -wings.base))
    assert good.body_kept_in_truth is None
    assert judge_sample(wings, truth, None, smaller).body_kept_in_truth is True
    assert judge_sample(wings, truth, None, elsewhere).body_kept_in_truth is False
    tail = next(pair for pair in pairs if pair.part == "tail" and not pair.closeup)
    assert good.body_named is None
    person = BodyNamer(SeesBrightness())  # type: ignore[arg-type]
    named = judge_sample(tail, tail.edited / np.float32(127), None, None, person)
    assert (named.body_named, named.body_named_in_truth) == (True, True)
    gone = judge_sample(tail, np.zeros_like(tail.edited, np.float32) - 1, None, None, person)
    assert (gone.body_named, gone.body_named_in_truth) == (False, True)
    closeup = next(pair for pair in pairs if pair.closeup)
    assert judge_sample(closeup, closeup.edited / np.float32(127), None, None, person).body_named is None
    assert judge_sample(tail, tail.edited / np.float32(127), SaysPart()).found is False  # it says wings
    assert judge_sample(tail, tail.edited / np.float32(127), None).found is None and tail.body == "person"
    assert judge_sample(tail, tail.edited / np.float32(127), None).held_out


def test_the_summary_counts_parts_and_plain_prompts_apart(pairs: list[Pair]) -> None:
    judged = [judge_sample(pair, pair.edited / np.float32(127), SaysPart()) for pair in pairs]
    report = summary(judged)
    assert report["per_part"]["wings"]["recall"] == 1 and report["per_part"]["tail"]["recall"] == 0
    assert report["overall"]["recall"] == 0.5 and report["overall"]["samples"] == 4
    plain = {"samples": 1, "unchanged": 1.0, "judged_none": 1.0, "shape_kept": 1.0, "body_error": 0.0}
    assert report["plain"] == plain
    assert report["bars"]["recall"]["met"] is False and report["bars"]["body kept pixel by pixel"]["met"] is True
    assert report["bars"]["recall of the weakest part"]["measured"] == 0
    assert summary([])["bars"]["recall"] == {"measured": None, "least": 0.85, "met": None}


def test_a_prior_is_sampled_and_judged_with_and_without_a_classifier(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    said: list[str] = []
    report = evaluate_parts(builtin_folder(), sheet, SaysPart(), ["ball"], ["wings"], steps=2, say=said.append)
    assert report == json.loads(sheet.with_suffix(".json").read_text())
    assert len(report["samples"]) == 2 + 3 and report["plain"]["samples"] == 3 and len(said) == 1
    with Image.open(sheet) as picture:
        assert picture.size == (5 * 64, 2 * 64)
    report = evaluate_parts(builtin_folder(), sheet, None, ["ball"], ["wings"], steps=1, closeups=False)
    assert report["overall"]["recall"] is None and report["overall"]["samples"] == 1
    with pytest.raises(UserError, match="'jetpack': no such name"):
        evaluate_parts(builtin_folder(), sheet, None, ["ball"], ["jetpack"])


def test_a_folder_without_a_judge_or_with_a_spoilt_one_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no judge of parts there"):
        load_judge(tmp_path)
    save_judge(PartNetwork(("crown", NOTHING)), tmp_path)
    assert load_judge(tmp_path).classes == ("crown", NOTHING)
    for spoilt in ('["crown"]', "[1, 2, 3]", "{"):
        (tmp_path / CLASSES_NAME).write_text(spoilt)
        with pytest.raises(UserError, match="classes.json: file of the built-in prior was changed"):
            load_judge(tmp_path)
        write_hashes(tmp_path, [tmp_path / CLASSES_NAME])
        with pytest.raises(UserError, match="cannot be read"):
            load_judge(tmp_path)
    with pytest.raises(UserError, match="no such judge of parts; give one of part_judge, part_judge_coarse"):
        judge_kind("part_judges")


def test_ring_views_of_the_renderer_are_those_of_the_corpus() -> None:
    elevation, half = 15.0, 1.25
    random = np.random.default_rng(3)
    body = BODIES["horse"](random)
    part = PARTS["wings"](body, random)
    both, aim = join([body.solid, part]), np.array([0.02, 0.15, -0.05])
    mesh = (torch.from_numpy(both.vertices).float(), torch.from_numpy(both.faces))
    rendered = judged_views(*mesh, aim, elevation, half)
    fov = 2 * np.rad2deg(np.arctan(half / CAMERA_RADIUS))
    for first in (0, 1):  # azimuths 0, 90, 180, 270 and 45, 135, ...
        camera = MosaicCamera(45.0 * first, elevation, fov, aim)
        origins, directions, rotations = camera.rays()
        drawn = views_of(shade(*RayCaster(both).cast(origins, directions), rotations)[None] / 127.0)
        difference = np.abs(rendered[first::2] - drawn)
        # Edges differ: 16 jittered samples a pixel here, a 2 x 2 pattern there.
        assert difference.mean() < 0.02 and (difference.max(1) > 0.5).mean() < 0.03
        flipped = np.abs(rendered[first::2][..., ::-1] - drawn)
        assert flipped.mean() > 5 * difference.mean()


def test_the_pairs_for_three_dimensions_cover_all_parts_and_half_were_never_trained() -> None:
    cases = benchmark("prior_pairs").CASES
    assert len(cases) == len({case.name for case in cases}) == 24
    assert {case.part for case in cases} == set(PARTS) and sum(case.untrained for case in cases) >= 12
    assert {case.kind for case in cases} - {None} <= set(BODIES)
    assert "a dog with horns" in {case.prompt for case in cases}


@pytest.mark.parametrize("name", ["skateboard_dog+horns", "rabbit_glasses+top_hat"])
def test_a_scene_of_its_own_has_the_regions_of_the_table(name: str, tmp_path: Path) -> None:
    in_3d = benchmark("prior_in_3d")
    case = next(case for case in in_3d.CASES if case.name == name)
    scene = load_edit_scene(in_3d.write_scene(case, tmp_path), prompt=case.prompt)
    shipped = load_edit_scene(BENCHMARKS.parent / "scenes" / case.scene / "scene.xml")
    assert scene.prompt == case.prompt and set(scene.parts) == {case.part.replace(" ", "_")}
    assert np.allclose(scene.base_soup.vertices, shipped.base_soup.vertices)
    for region, wanted in zip(scene.regions, case.ellipsoids, strict=True):
        linear = region.to_canonical[:3, :3]
        assert np.allclose(region.to_canonical[:3, 3], wanted.centre, atol=1e-4)
        assert np.allclose(np.linalg.norm(linear, axis=0), wanted.half_axes, rtol=1e-4)
        along = linear[:, 0] / np.linalg.norm(linear[:, 0])
        assert along[1] / along[0] == pytest.approx(np.tan(np.deg2rad(wanted.about_z)), rel=1e-3)
        assert share_in_grid(region) > 0.9


def test_a_run_that_failed_has_found_nothing() -> None:
    in_3d = benchmark("prior_in_3d")
    good = {"part": "horn", "untrained": True, "end": {"found": 0.9, "found_where_seen": 1.0, "named": "horn"}}
    good["start"] = {"found": 0.1}
    figures = in_3d.summary({"a": good, "b": {"part": "tail", "untrained": False, "problem": "vanished"}})
    assert figures["all"]["found"] == 0.45 and figures["untrained"]["found"] == 0.9 and figures["trained"]["found"] == 0
    assert figures["all"]["named_right"] == 0.5
    assert figures["bars"]["found"]["met"] is False and figures["bars"]["found_at_start"]["met"] is True


@pytest.mark.parametrize("folder", [CHECKOUT_CLASSIFIER, JUDGE_FOLDER], ids=["benchmarks", "shipped"])
def test_the_judges_name_parts_of_unseen_bodies(folder: Path) -> None:
    judge = load_judge(folder)
    kind = JUDGE_KINDS["part_judge_coarse" if folder == CHECKOUT_CLASSIFIER else "part_judge"]
    assert judge.classes == kind.classes
    seed = UNSEEN_SEED + kind.seed * SEEDS_APART + 99
    made = [make_views(body, seed, kind.catalogue, kind.lump_share) for body in ("horse", "mug")]
    before, after = (np.concatenate([getattr(m, n) for m in made]) / np.float32(127) for n in ("before", "after"))
    label, blob = (np.concatenate([getattr(m, n) for m in made]) for n in ("label", "blob"))
    said = judge(before, after)
    assert said.shape == (len(label), len(kind.classes)) and np.allclose(said.sum(1), 1, atol=1e-5)
    assert (said.argmax(1) == label).mean() > 0.75 and (said[blob].argmax(1) == label[blob]).mean() > 0.75
    assert (judge(before, before).argmax(1) == judge.classes.index(NOTHING)).mean() > 0.97
    assert sum(path.stat().st_size for path in folder.glob("*.safetensors")) < 2e6


def test_a_judge_is_trained_goes_on_and_is_measured(tmp_path: Path) -> None:
    few = replace(COARSE, body_weights={"mug": 1.0, "ball": 1.0}, part_weights={"handle": 1.0, "crown": 1.0})
    kind = JudgeKind(few, lump_share=1.0, bodies=2, steps=6, seed=3)
    train_part_judge(tmp_path, kind, seconds=600, steps=4)
    log = (tmp_path / "log.jsonl").read_text() if (tmp_path / "log.jsonl").exists() else ""
    first = load_judge(tmp_path).network.head.weight.clone()
    train_part_judge(tmp_path, kind, seconds=600)
    judge = load_judge(tmp_path)
    assert judge.classes == ("handle", "crown", "none") and log == ""
    assert not torch.equal(first, judge.network.head.weight)
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["step"] == 6
    figures = measure(judge, kind, 1)
    assert set(figures["per_part"]) == set(judge.classes) and set(figures["per_body"]) == {"mug", "ball"}
    assert 0 <= figures["accuracy"] <= 1 and figures["views"] > 20


def test_a_view_of_a_larger_picture_is_a_mean() -> None:
    assert seen_by_judge(np.ones((2, 4, 64, 64), np.float32)).shape == (2, 4, 32, 32)


def test_a_prompt_that_takes_a_part_away_is_judged_by_what_is_left() -> None:
    pairs = [pair for seed in range(4) for pair in make_fine_pairs("elephant", ["crown", "tusks", "wings"], seed)]
    removed = next(pair for pair in pairs if pair.removed)
    wanted, before = (latent / np.float32(127) for latent in (removed.edited, removed.base))
    gone, still = (judge_sample(removed, picture, SaysPart(), kind=GEOMETRY_FINE) for picture in (wanted, before))
    assert (gone.taken_off, still.taken_off) == (True, False) and gone.found is gone.part is None
    added = next(pair for pair in pairs if not pair.removed)
    assert judge_sample(added, added.edited / np.float32(127), None, kind=GEOMETRY_FINE).taken_off is None
    report = summary([gone, still])
    assert report["removal"] == {"samples": 2, "taken_off": 0.5} and report["plain"]["samples"] == 0
