"""What is understood of prompts in people's words, and what a model with a list of words is told of them."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_check import take_prompt
from fd_mitsuba.guidance.prompt_reader import PromptReading, known_text, read_prompt
from fd_mitsuba.guidance.understood_prompt import understood_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.guidance.word_table import word_table
from fd_mitsuba.prior.data.captions import BODY_WORDS, PART_WORDS, caption, random_style, word_lists

ROOT = Path(__file__).resolve().parents[2]
PROMPTS = json.loads((ROOT / "tests" / "data" / "prompts.json").read_text(encoding="utf-8"))
BODIES, PARTS = "horse dog cat".split(), "wings horn horns crown".split()


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return Vocabulary.model_validate(word_lists())


@pytest.fixture(scope="module")
def more_words(vocabulary: Vocabulary) -> Vocabulary:
    """A prior that knows a scarf, bat wings and a dragon."""
    lists = vocabulary.model_dump()
    lists["parts"] |= {"scarf": ("a scarf",), "bat wings": ("bat wings", "a pair of bat wings")}
    lists["bodies"] |= {"dragon": ("dragon",), "head": ("head", "face")}
    return Vocabulary.model_validate(lists)


def means(reading: PromptReading, meant: dict) -> bool:
    """Whether a reading agrees with an entry of prompts.json."""
    if meant["part"] is None:
        return reading.parts == () and bool(set(reading.removed) & set(meant["not"]))
    parts = meant["part"] if isinstance(meant["part"], list) else [meant["part"]]
    return (
        len(reading.parts) == 1
        and reading.parts[0] in parts
        and reading.bodies[:1] <= tuple(meant["body"])
        and len(reading.bodies) == 1
        and reading.bodies[0] in meant["body"]
        and set(meant.get("style", ())) <= set(reading.styles)
    )


def test_prompts_in_peoples_words_are_read_as_meant_and_none_as_the_opposite(vocabulary: Vocabulary) -> None:
    readings = {row["prompt"]: read_prompt(row["prompt"], vocabulary) for row in PROMPTS}
    wrong = [row["prompt"] for row in PROMPTS if not means(readings[row["prompt"]], row)]
    assert len(PROMPTS) >= 40 and len(wrong) <= len(PROMPTS) // 10, wrong
    opposite = [row["prompt"] for row in PROMPTS if set(readings[row["prompt"]].parts) & set(row.get("not", ()))]
    assert not opposite


def test_every_caption_of_the_training_comes_out_unchanged(vocabulary: Vocabulary) -> None:
    rng = np.random.default_rng(0)
    for _ in range(1500):
        body, part = (list(words)[rng.integers(len(words))] for words in (BODY_WORDS, PART_WORDS))
        text = caption(body, part, rng, random_style(rng) if rng.random() < 0.5 else "")
        reading = read_prompt(text, vocabulary)
        assert (reading.caption, reading.parts, reading.ignored) == (text, (part,), ()), text
        assert reading.bodies == (body,), text


SHIPPED = {
    "bronze_bull": "a golden bull with two curved golden horns",
    "cat": "a cat with a crown",
    "deer": "a realistic brown deer with a pair of antlers",
    "mug": "a mug with a handle",
    "pegasus": "a horse with two wings",
    "rabbit_glasses": "a cute brown rabbit wearing round glasses",
    "skateboard_dog": "a dog on a skateboard",
    "snowman": "a snowman with a pointed hat",
    "superhero": "a person wearing a long red cape",
    "teddy_backpack": "a cute teddy bear with a school bag",
    "unicorn": "a beautiful white pony with a pointed horn",
    "vase": "a white vase with a big flower",
    "wooden_horse": "a wooden horse with two wooden wings",
}
"""What the priors were told for the shipped scenes before there was a reader, by their results."""


@pytest.mark.parametrize("appearance", [False, True])
def test_the_shipped_scenes_say_to_the_shipped_priors_what_they_always_said(appearance: bool) -> None:
    shipped = vocabulary_of("builtin", appearance)
    for name, text in SHIPPED.items():
        scene = (ROOT / "scenes" / name / "scene.xml").read_text(encoding="utf-8")
        assert re.search(r'<default name="prompt" value="([^"]+)"', scene)[1] == text
        assert read_prompt(text, shipped).caption == text
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        from prior_pairs import CASES
    finally:
        sys.path.pop(0)
    for case in CASES:
        if case.kind is not None:
            assert read_prompt(case.prompt, shipped).caption == case.prompt


def test_words_that_the_prior_does_not_know_change_nothing_that_is_encoded(vocabulary: Vocabulary) -> None:
    guidance = DiffusionGuidance.load(GuidanceConfig(model="builtin"))
    views = GuidanceViews(torch.zeros(4, 5, 32, 32), None, [10.0, 100.0, 190.0, 280.0], [20.0] * 4, closeup=True)

    def encoded(prompt: str) -> tuple[list[str], bytes]:
        take_prompt(guidance, prompt, "", lambda line: None)
        texts = guidance.prompts(views)
        return texts, guidance.embeddings(texts, ["text"])["text"].numpy().tobytes()

    for plain, more in {
        "a horse with two wings": "an iridescent horse with two shimmering angelic wings, trending on artstation",
        "a cute brown rabbit wearing round glasses": "the cute clumsy brown rabbit wearing round hipster glasses!",
        "a duck with glasses": "a rubber duck with glasses",
        "a dog with a crown": "a grumpy dog with an elaborate crown",
    }.items():
        assert encoded(plain) == encoded(more), more
        assert read_prompt(more, vocabulary).ignored and not read_prompt(plain, vocabulary).ignored


def test_any_adjective_before_any_word_is_dropped(vocabulary: Vocabulary) -> None:
    for prompt in SHIPPED.values():
        words = prompt.split()
        for place in range(1, len(words)):
            if " ".join(words[place - 1 : place + 1]) in ("a pair", "pair of", "teddy bear", "school bag"):
                continue  # inside a phrase it is another phrase
            longer = " ".join([*words[:place], "sparkly", *words[place:]])
            reading = read_prompt(longer, vocabulary)
            assert (reading.caption, reading.ignored) == (prompt, ("sparkly",)), longer


@pytest.mark.parametrize(
    ("prompt", "told"),
    [
        ("a cat with a CROWN!", "a cat with a crown"),
        ("the horns on an angry bull", "a bull with horns"),
        ("a pony with a pointed horn of silver", "a pony with a pointed horn made of silver"),
        ("a crown made of blue plastic for the cat", "a cat with a blue plastic crown"),
        ("a cat with a scarlet tiara", "a cat with a red crown"),
        ("pegasus", "a pegasus"),
        ("a unicorn with a crown", "a horse with a crown"),
        ("a butterfly with a crown", "a figure with a crown"),
        ("a glass ball with wings", "a ball with wings"),
        ("a cat with glasses and a top hat", "a cat with glasses and a top hat"),
        ("give the bull horns", "a cow with bull horns"),
    ],
)
def test_captions(vocabulary: Vocabulary, prompt: str, told: str) -> None:
    assert read_prompt(prompt, vocabulary).caption == told


@pytest.mark.parametrize(
    "prompt",
    [
        "a horse without wings", "no wings, horns or crown", "a horse with no wings", "a wingless horse",
        "an unwinged horse", "take the wings off", "a horse with its wings cut off", "don't give the horse wings",
        "a horse that isn't wearing a crown", "a horse minus its horn", "a horse w/o horn", "hornless horse",
        "the horse's horn removed", "a horse with neither wings nor crown", "a non-winged horse", "horn-free horse",
        "a dog lacking a crown", "never a crown", "a horse with fewer horns", "get rid of the crown",
    ],
)  # fmt: skip
def test_a_negation_never_asks_for_what_it_negates(vocabulary: Vocabulary, prompt: str) -> None:
    reading = read_prompt(prompt, vocabulary)
    assert reading.parts == () and reading.caption == "" and reading.removed
    with pytest.raises(UserError, match="mode"):
        understood_prompt(prompt, vocabulary)


def test_parts_beside_a_negation_are_read(vocabulary: Vocabulary) -> None:
    for prompt in (
        "replace the cat's hat with a crown", "a cat with a crown but no hat", "a cat without a hat, wearing a crown",
        "a hatless cat with a crown", "take the hat off and put a crown on the cat", "a crown rather than a hat, cat",
    ):  # fmt: skip
        reading = read_prompt(prompt, vocabulary)
        assert reading.parts == ("crown",) and reading.removed == ("pointed hat",), prompt
        assert "not wanted: pointed hat" in reading.summary()


def test_synonyms_of_words_that_a_prior_does_not_know_are_reported(
    vocabulary: Vocabulary, more_words: Vocabulary
) -> None:
    assert read_prompt("a bear with a muffler", vocabulary).unknown_parts == ("scarf",)
    with pytest.raises(UserError, match="knows no part 'scarf'"):
        understood_prompt("a bear with a muffler", vocabulary)
    both = understood_prompt("a bear with a muffler and a crown", vocabulary)
    assert both.parts == ("crown",) and "not known: scarf" in both.summary()
    assert read_prompt("a bear with a red muffler", more_words).caption == "a bear with a red scarf"
    for prompt, told in {
        "a wyvern with demon wings": "a dragon with bat wings",
        "a face with glasses": "a face with glasses",
        "a crown on the dog's head": "a dog with a crown",
    }.items():
        assert read_prompt(prompt, more_words).caption == told


def test_the_base_prompt_says_the_body_where_the_prompt_does_not(vocabulary: Vocabulary) -> None:
    assert read_prompt("put a crown on its head", vocabulary, "a small duck").caption == "a duck with a crown"
    assert read_prompt("a cat with a crown", vocabulary, "a small duck").caption == "a cat with a crown"


def test_summary_says_what_was_understood(vocabulary: Vocabulary) -> None:
    summary = read_prompt("a cuddly rabbit with a red wizard's hat", vocabulary).summary()
    assert summary == "part: pointed hat; look: red; body: rabbit; ignored: cuddly"
    assert read_prompt("winged lion", vocabulary).summary() == "part: wings (for 'winged'); body: cat (for 'lion')"


def test_the_nearest_parts_are_named(vocabulary: Vocabulary) -> None:
    assert "crown" in read_prompt("a horse with a croun", vocabulary).nearest
    assert read_prompt("xylophone", vocabulary).nearest == ()


def test_the_table_contradicts_neither_itself_nor_the_prior(vocabulary: Vocabulary) -> None:
    table = word_table()
    words = [word for group in (table.parts, table.bodies) for others in group.values() for word in others]
    assert len(words) == len(set(words)), sorted(word for word in words if words.count(word) > 1)
    assert set(vocabulary.parts) <= set(table.parts) and set(vocabulary.bodies) <= set(table.bodies)
    assert set(table.attributes.values()) | set(table.part_stand_ins) <= set(table.parts)
    assert set(table.body_stand_ins) <= set(table.bodies) >= set(table.whole_bodies.values())
    assert set(vocabulary.wholes) <= set(table.whole_bodies)


class Listening:
    """A guidance that keeps what it is told."""

    def __init__(self, vocabulary: Vocabulary | None) -> None:
        self.conventions, self.told = SimpleNamespace(vocabulary=vocabulary), []

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        self.told += [prompt, negative_prompt]
        return []

    def set_part_prompts(self, prompts: dict[str, tuple[str, str]]) -> None:
        self.parts = prompts


def test_other_models_get_prompts_as_they_are(vocabulary: Vocabulary) -> None:
    other, own, heard = Listening(None), Listening(vocabulary), []
    text = "A stallion, w/o Wings; ultra-detailed 8K"
    take_prompt(other, text, "Blurry, ugly wings", heard.append)
    assert other.told == [text, "Blurry, ugly wings"] and heard == []
    take_prompt(own, "the duck: 8K crown", "blurry, a cat with Wings", heard.append)
    assert own.told == ["a duck with a crown", "a cat with wings"]
    assert heard == ["prompt read as part: crown; body: duck; ignored: 8k"]
    assert known_text("blurry", vocabulary) == "" and other.parts == own.parts == {}


def test_the_prompts_of_parts_are_read_alike(vocabulary: Vocabulary) -> None:
    other, own, heard = Listening(None), Listening(vocabulary), []
    parts = {"hat": ("an elegant wizard hat", ""), "back": ("angelic wings", "blurry, a crown")}
    take_prompt(other, "a cat", "", heard.append, "a cat", parts)
    assert other.parts == parts and heard == []
    take_prompt(own, "a kitten with wings and a hat", "", heard.append, "a grey cat", parts)
    assert own.parts == {"hat": ("a cat with a wizard hat", ""), "back": ("a cat with wings", "a crown")}
    assert [line.split(" read")[0] for line in heard] == ["prompt", "prompt of part 'hat'", "prompt of part 'back'"]
    with pytest.raises(UserError, match="part 'hat': prompt 'a sofa'.*reword"):
        take_prompt(own, "a cat with wings", "", heard.append, "a cat", {"hat": ("a sofa", "")})


REMOVALS = {
    ("a mug without a handle", ""): ("a mug without a handle", "taken off: handle; body: mug"),
    ("remove the handle", "a mug with a handle"): ("a mug without a handle", "taken off: handle; body: mug"),
    ("take the golden crown off the cat's head", ""): (
        "a cat without a crown",
        "taken off: crown; body: cat; ignored: golden",
    ),
    ("a wingless horse", ""): ("a horse without wings", "taken off: wings; body: horse"),
    ("unicorn with no horn", ""): ("a horse without a horn", "taken off: horn; body: horse"),
    ("the deer, antlers removed", ""): ("a deer without antlers", "taken off: antlers; body: deer"),
    ("no horns and no wings on the cow", ""): ("a cow without horns and wings", "taken off: horns, wings; body: cow"),
    ("a horse with its red wings removed", ""): (
        "a horse without wings",
        "taken off: wings; body: horse; ignored: red",
    ),
    ("take off the shades", "a cat"): ("a cat without glasses", "taken off: glasses (for 'shades'); body: cat"),
}
NOT_REMOVALS = (
    "don't remove the handle",
    "never take off the handle",
    "a mug not without a handle",
    "a mug that isn't without a handle",
    "remove all except the handle",
)


def test_a_prior_that_takes_parts_off_is_told_so() -> None:
    fine = vocabulary_of("builtin-wide")
    assert fine is not None and fine.takes_off
    for (prompt, base), (told, summary) in REMOVALS.items():
        reading = understood_prompt(prompt, fine, base, subtracts=True)
        assert (reading.caption, reading.summary()) == (told, summary)
        assert set(told.split()) <= fine.known_words()
        with pytest.raises(UserError, match=r'"subtract"/> \(--subtract\)$'):
            understood_prompt(prompt, fine, base)


def test_what_is_taken_off_and_what_is_added_are_not_mixed_up(vocabulary: Vocabulary) -> None:
    fine = vocabulary_of("builtin-wide")
    assert fine is not None and not vocabulary.takes_off
    with pytest.raises(UserError, match="guidance.model=builtin-wide, which can take parts off.*lambda_sds=0"):
        understood_prompt("a mug without a handle", vocabulary, subtracts=True)
    with pytest.raises(UserError, match="asks for crown.*what to take off"):
        understood_prompt("a cat with a crown but no wings", fine, subtracts=True)
    for prompt, word in (("an elephant without its trunk", "trunk"), ("a mug without a hanlde", "hanlde")):
        with pytest.raises(UserError, match=f"takes off no part that .* knows, for it does not know '{word}'"):
            understood_prompt(prompt, fine, subtracts=True)
    with pytest.raises(UserError, match="takes off no part that the built-in prior knows; say"):
        understood_prompt("an elephant", fine, subtracts=True)
    for prompt in NOT_REMOVALS:
        with pytest.raises(UserError, match="can be read both ways.*what is to go"):
            understood_prompt(prompt, fine, subtracts=True)
    own = Listening(fine)
    take_prompt(own, "no crown", "", lambda line: None, "a cat", {"left": ("no wings", "")}, subtracts=True)
    assert own.told == ["a cat without a crown", ""] and own.parts == {"left": ("a cat without wings", "")}
