from __future__ import annotations

import pytest

from fd_mitsuba.guidance.vocabulary import Vocabulary, read_prompt
from fd_mitsuba.prior.data.captions import PART_WORDS, word_lists


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return Vocabulary.model_validate(word_lists())


@pytest.mark.parametrize(
    ("prompt", "parts", "bodies"),
    [
        ("A horse with two wings", ("wings",), ("horse",)),
        ("a teddy bear wearing a golden Crown!", ("crown",), ("bear",)),
        ("a unicorn", ("horn",), ()),
        ("a cat with glasses and a top hat", ("top hat", "glasses"), ("cat",)),
        ("a horse", (), ("horse",)),
        ("a horse with a hat", (), ("horse",)),
    ],
)
def test_parts_and_bodies_are_found(vocabulary: Vocabulary, prompt: str, parts: tuple, bodies: tuple) -> None:
    reading = read_prompt(prompt, vocabulary)
    assert set(reading.parts) == set(parts) and reading.bodies == bodies and reading.ignored == ()


def test_words_outside_are_listed_and_the_nearest_parts_named(vocabulary: Vocabulary) -> None:
    reading = read_prompt("a sleepy horse with a wing and a jetpack", vocabulary)
    assert reading.ignored == ("sleepy", "wing", "jetpack") and reading.parts == ()
    assert "wings" in reading.nearest
    assert set(read_prompt("a cat with a hat", vocabulary).nearest) <= {
        w.removeprefix("a ") for w in sum((PART_WORDS[name] for name in ("pointed hat", "top hat")), ())
    }
    assert read_prompt("xylophone", vocabulary).nearest == ()


def test_every_part_phrase_is_understood_as_its_part(vocabulary: Vocabulary) -> None:
    for name, phrases in PART_WORDS.items():
        for phrase in phrases:
            assert name in read_prompt(f"a dog with {phrase}", vocabulary).parts, phrase
