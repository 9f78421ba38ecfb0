"""What the finer prior's captions say: more bodies and parts, words for what has no name, and removal."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data import captions as coarse
from fd_mitsuba.prior.data.captions import AZIMUTH_WORDS, CLOSEUP_WORD, COLOURS, MATERIALS, random_style, styled
from fd_mitsuba.prior.data.fine.bodies import NAMELESS

BODY_WORDS: dict[str, tuple[str, ...]] = {
    **coarse.BODY_WORDS,
    "person": ("person", "figure", "man", "woman", "human"),
    "duck": ("duck", "bird"),
    "elephant": ("elephant", "mammoth"),
    "dragon": ("dragon", "dinosaur", "lizard"),
    "chair": ("chair", "seat"),
    "car": ("car", "automobile"),
    "teapot": ("teapot", "kettle"),
    "bottle": ("bottle", "flask"),
    "shoe": ("shoe", "sneaker"),
    "house": ("house", "building"),
    "tree": ("tree",),
    "head": ("head", "face", "bust"),
    NAMELESS: ("object", "thing"),
}
"""Synonyms a body; the first is the one that messages use, and that half of the captions say."""
NEUTRAL = ("an object", "an object", "a thing", "something")
NEUTRAL_SHARE = 0.15
"""Captions of a known body that do not name it, so that a body without a name may be called so."""

PART_WORDS: dict[str, tuple[str, ...]] = {
    **coarse.PART_WORDS,
    "wings": ("wings", "two wings", "feathered wings", "a pair of wings", "angel wings", "bird wings"),
    "pointed hat": ("a pointed hat", "a wizard hat", "a witch hat", "a party hat", "a cone hat"),
    "top hat": ("a top hat", "a tall hat", "a cylinder hat"),
    "crown": ("a crown", "a royal crown", "a tiara"),
    "cape": ("a cape", "a cloak", "a long cape"),
    "glasses": ("glasses", "round glasses", "a pair of glasses", "spectacles", "sunglasses"),
    "skateboard": ("a skateboard", "a board with wheels"),
    "flower": ("a flower", "a daisy", "a big flower"),
    "butterfly": ("a butterfly", "a big butterfly"),
    "spikes": ("spikes", "a row of spikes", "large spikes"),
    "bat wings": ("bat wings", "dragon wings", "a pair of bat wings", "demon wings", "leathery wings"),
    "hat": ("a hat", "a sun hat", "a straw hat", "a cowboy hat", "a bowler hat"),
    "halo": ("a halo", "a ring above its head"),
    "mushroom cap": ("a mushroom cap", "a mushroom hat", "a mushroom"),
    "candle": ("a candle", "a burning candle"),
    "propeller": ("a propeller", "a rotor"),
    "ears": ("ears", "two ears", "bunny ears", "long ears", "a pair of ears"),
    "umbrella": ("an umbrella", "a parasol"),
    "scarf": ("a scarf", "a long scarf", "a knitted scarf"),
    "bow tie": ("a bow tie", "a bow"),
    "sword": ("a sword", "a long sword"),
    "shield": ("a shield", "a big shield"),
    "saddle": ("a saddle", "a leather saddle"),
    "boots": ("boots", "a pair of boots", "leather boots", "shoes"),
    "fin": ("a fin", "a shark fin", "a dorsal fin"),
    "tusks": ("tusks", "two tusks", "a pair of tusks"),
}
WORN = (*coarse.WORN, "hat", "halo", "mushroom cap", "propeller", "ears", "scarf", "bow tie", "boots", "saddle")
HELD_OUT = coarse.HELD_OUT | {
    ("elephant", "crown"),
    ("head", "bow tie"),
    ("dragon", "hat"),
    ("car", "wings"),
    ("teapot", "scarf"),
    ("bottle", "handle"),
    ("dog", "saddle"),
    ("house", "umbrella"),
    ("person", "sword"),
    ("chair", "spikes"),
}
"""Pairs that training never shows."""
SYNONYM_WHOLES = coarse.SYNONYM_WHOLES
ADJECTIVES = ("", "", "", "", "", "cute", "small", "white", "brown", "beautiful", "realistic", "detailed")
WITHOUT, NO = "without", "no"
_ARTICLES = ("a pair of ", "a row of ", "a ", "an ", "one ", "two ")


def bare(phrase: str) -> str:
    """The phrase without its article or number."""
    for article in _ARTICLES:
        if phrase.startswith(article):
            return phrase.removeprefix(article)
    return phrase


def with_article(phrase: str) -> str:
    return f"{'an' if phrase[0] in 'aeiou' else 'a'} {phrase}"


def _either(rng: np.random.Generator, words: tuple[str, ...]) -> str:
    """The first word in half of the cases."""
    return words[0] if rng.random() < 0.5 else words[rng.integers(len(words))]


def subject_of(body: str, rng: np.random.Generator) -> str:
    """The body in words, or words that name none."""
    if body == NAMELESS or rng.random() < NEUTRAL_SHARE:
        return NEUTRAL[rng.integers(len(NEUTRAL))]
    adjective = ADJECTIVES[rng.integers(len(ADJECTIVES))]
    return with_article(" ".join(word for word in (adjective, _either(rng, BODY_WORDS[body])) if word))


def caption(
    body: str, part: str | None, rng: np.random.Generator, removed: bool = False, style: str | None = None
) -> str:
    """A sentence that names the body and what is added, or with `removed` what is taken away.

    Args:
        style: a colour or material for the part, empty for none; None: now and then a random one.
    """
    subject = subject_of(body, rng)
    if part is None:
        return subject
    phrase = _either(rng, PART_WORDS[part])
    if removed:
        return f"{subject} with {NO} {bare(phrase)}" if rng.random() < 0.2 else f"{subject} {WITHOUT} {phrase}"
    if style is None:
        style = random_style(rng) if rng.random() < STYLED_SHARE else ""
    phrase = styled(phrase, style)
    wholes = SYNONYM_WHOLES.get((body, part), ())
    if wholes and not style and rng.random() < 0.2:
        return with_article(wholes[rng.integers(len(wholes))])
    links = ["with", "with", "with", "that has"]
    if part in WORN:
        links += ["wearing", "wearing"]
    if part == "skateboard":
        links = ["on", "standing on", "riding", "with"]
    return f"{subject} {links[rng.integers(len(links))]} {phrase}"


STYLED_SHARE = 0.2
"""Captions that also name a colour or material, which normals do not show: the words must not disturb the shape."""


def word_lists() -> dict[str, dict | list[str]]:
    """The vocabulary as `guidance.vocabulary.Vocabulary` reads it: what a user may write in a prompt."""
    return coarse.listed_words(BODY_WORDS, PART_WORDS, SYNONYM_WHOLES, vocabulary())


def vocabulary() -> list[str]:
    """Every word of every caption, sorted; the coarse prior's among them, so that its weights can be a start."""
    texts = [w for words in (*BODY_WORDS.values(), *PART_WORDS.values(), *SYNONYM_WHOLES.values()) for w in words]
    texts += [
        *ADJECTIVES,
        *NEUTRAL,
        *AZIMUTH_WORDS,
        CLOSEUP_WORD,
        *COLOURS,
        *(word for words in MATERIALS.values() for word in words),
        f"{WITHOUT} {NO}",
        *coarse.vocabulary(),
    ]
    return sorted({word for text in texts for word in text.split()})
