"""Whether the built-in judge tells a part from another, from a bare start, from a lump and from nothing."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fd_mitsuba.evaluation.part_judge import PartClassifier, load_judge
from fd_mitsuba.evaluation.verdict import LIKE, NOTHING, SURE, Verdict, Verdicts, judge_part, part_shares
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.data.primitives import Solid, join
from fd_mitsuba.prior.data.starts import starts_like
from fd_mitsuba.prior.pictures.part_corpus import UNSEEN_SEED, lumps_of
from fd_mitsuba.scene.focal_region import PartPrompt


@pytest.fixture(scope="module")
def judge() -> PartClassifier:
    return load_judge()


def surface(body: Solid, part: Solid | None) -> SimpleNamespace:
    whole = body if part is None else join([body, part])
    weight = torch.zeros(len(whole.vertices))
    weight[len(body.vertices) :] = 1
    return SimpleNamespace(
        vertices=torch.from_numpy(whole.vertices).float(),
        faces=torch.from_numpy(np.asarray(whole.faces, np.int64)),
        part_weight=weight,
    )


def stage_of(body: str, part: str, prompt: str, grown: str = "part", base_prompt: str = "") -> SimpleNamespace:
    """A finished stage whose part is one that no training had, or the start, or lumps, or nothing."""
    rng = np.random.default_rng([UNSEEN_SEED + 999, list(PARTS).index(part)])
    made = BODIES[body](rng)
    true = PARTS[part](made, rng)
    begun = starts_like(true, rng)
    end = {"part": true, "start": begun, "lumps": lumps_of(true, rng), "nothing": None}[grown]
    return SimpleNamespace(
        scene=SimpleNamespace(prompt=prompt, base_prompt=base_prompt),
        aim=np.zeros(3),
        surface=lambda: surface(made.solid, end),
        start_surface=lambda: surface(made.solid, begun),
        base_surface=surface(made.solid, None),
    )


SEEN = [("cat", "crown"), ("horse", "wings"), ("rabbit", "pointed hat"), ("dog", "skateboard"), ("deer", "antlers")]


@pytest.mark.parametrize(("body", "part"), SEEN)
def test_unseen_true_parts_look_like_their_prompt_and_like_no_other(
    judge: PartClassifier, body: str, part: str
) -> None:
    words = vocabulary_of("builtin")
    prompt = f"a {body} with {words.parts[part][0]}"
    right = judge_part(stage_of(body, part, prompt), judge, words)
    assert right.looks_like and next(iter(right.shares)) == part and right.views > 12
    assert right.line().startswith(f"looks like: {part} ") and sum(right.shares.values()) == pytest.approx(1)
    other = judge_part(stage_of(body, part, f"a {body} with glasses"), judge, words)
    assert not other.looks_like and "does NOT look like glasses" in other.line()
    assert f"nearest: {part}" in other.line() and "\n" not in other.line()


@pytest.mark.parametrize(("body", "part"), SEEN)
def test_a_start_that_stayed_lumps_and_a_part_that_vanished_do_not(judge: PartClassifier, body: str, part: str) -> None:
    words = vocabulary_of("builtin")
    prompt = f"a {body} with {words.parts[part][0]}"
    start = judge_part(stage_of(body, part, prompt, "start"), judge, words)
    assert not start.looks_like and start.score == 0.0 and start.gain == pytest.approx(0, abs=1e-6)
    assert "NOT" in start.line()
    lumps = judge_part(stage_of(body, part, prompt, "lumps"), judge, words)
    assert not lumps.sure and lumps.share < 0.7
    gone = judge_part(stage_of(body, part, prompt, "nothing"), judge, words)
    assert not gone.looks_like and gone.shares[NOTHING] == 1.0 and "no view shows it" in gone.line()


def test_each_of_several_parts_is_judged_as_if_the_others_had_been_there(judge: PartClassifier) -> None:
    rng = np.random.default_rng(UNSEEN_SEED)
    made = BODIES["dog"](rng)
    true = {"hat": PARTS["pointed hat"](made, rng), "board": PARTS["skateboard"](made, rng)}
    begun = {name: starts_like(part, rng) for name, part in true.items()}
    words, body = vocabulary_of("builtin"), made.solid

    def balls(part: Solid) -> tuple[SimpleNamespace]:
        centre = (part.vertices.min(0) + part.vertices.max(0)) / 2
        return (SimpleNamespace(sdf=lambda points: -np.linalg.norm(points - centre, axis=1)),)

    def said(**prompts: str) -> dict[str, Verdict]:
        scene = SimpleNamespace(
            prompt="a dog with a pointed hat on a skateboard",
            base_prompt="a dog",
            parts={name: balls(part) for name, part in true.items()},
            part_prompts={name: PartPrompt(prompt) for name, prompt in prompts.items()},
        )
        stage = SimpleNamespace(
            scene=scene,
            aim=np.zeros(3),
            surface=lambda: surface(body, join(list(true.values()))),
            start_surface=lambda: surface(body, join(list(begun.values()))),
            base_surface=surface(body, None),
        )
        assert judge_part(stage, judge, words) is None  # by the prompt of both
        return {name: judge_part(stage, judge, words, of=name) for name in prompts}

    right = said(hat="a dog with a pointed hat", board="a dog on a skateboard")
    assert right["hat"].looks_like and right["board"].looks_like
    wrong = said(hat="a dog on a skateboard", board="a dog with a pointed hat")
    assert not wrong["hat"].looks_like and not wrong["board"].looks_like
    both = Verdicts({"hat": right["hat"], "board": wrong["board"]})
    assert both.score == wrong["board"].score and not both.to_json()["looks_like"]
    assert both.line() == f"hat {right['hat'].line()}; board {wrong['board'].line()}"


def test_only_prompts_in_the_words_of_the_judge_are_judged(judge: PartClassifier) -> None:
    words = vocabulary_of("builtin")
    for prompt in ("a cat with a jetpack", "a cat without a crown", "a cat with a crown and a cape"):
        assert judge_part(stage_of("cat", "crown", prompt), judge, words) is None
    lists = words.model_dump()
    lists["parts"]["jetpack"] = ("a jetpack",)
    assert judge_part(stage_of("cat", "crown", "a cat with a jetpack"), judge, type(words)(**lists)) is None
    assert judge_part(stage_of("cat", "crown", "add a tiara, please"), judge, words).looks_like


def test_shares_are_means_over_the_views_that_show_the_part() -> None:
    """A judge that reads its answer from a pixel of the picture after."""

    class Reads:
        classes = ("crown", "tail", "handle", "none")

        def __call__(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
            return np.stack([after[:, channel, 0, 0] for channel in range(4)], 1)

    before, after = (np.zeros((4, 4, 32, 32), np.float32) for _ in range(2))
    after[:3, :, 8:16, 8:16] = 1.0
    after[3, :, 8:12, 8:12] = 1.0  # 16 pixels of 64: less than a third, does not count
    after[:, :, 0, 0] = [[0.5, 0.1, 0.2, 0.2], [0.7, 0.1, 0.2, 0.0], [0.6, 0.1, 0.1, 0.2], [0.0, 1.0, 0.0, 0.0]]
    shares, views = part_shares(Reads(), ["crown", "tail"], [(before, after)])
    assert views == 3 and shares == pytest.approx([1.8 / 2.5, 0.3 / 2.5, 0.4 / 2.5])
    assert part_shares(Reads(), ["crown"], [(before, before)]) == ([0.0, 1.0], 0)


def test_lines() -> None:
    def verdict(**shares: float) -> Verdict:
        return Verdict("glasses", shares, 3.0, 20, "judge")

    assert verdict(glasses=0.62, butterfly=0.2, crown=0.02).line() == "looks like: glasses .62, butterfly .20"
    unsure = verdict(glasses=0.4, backpack=0.3)
    assert "does NOT look like glasses (.40); the judge is unsure" in unsure.line()
    assert "still much as it started" in Verdict("wings", {"wings": 0.9}, 0.2, 20, "judge").line()
    wrong = verdict(backpack=0.7, glasses=0.1)
    assert "nearest: backpack .70; enlarge or move the region" in wrong.line() and not wrong.sure
    assert wrong.to_json()["shares"] == {"backpack": 0.7, "glasses": 0.1} and LIKE < SURE
