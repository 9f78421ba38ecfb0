"""What the built-in prior's training captions say, and so the words that it knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

BODY_WORDS: dict[str, tuple[str, ...]] = {
    "horse": ("horse", "pony", "stallion"),
    "dog": ("dog", "puppy", "hound"),
    "cat": ("cat", "kitten"),
    "deer": ("deer", "stag"),
    "cow": ("cow", "bull"),
    "pig": ("pig", "piglet"),
    "bear": ("bear", "teddy bear"),
    "rabbit": ("rabbit", "bunny"),
    "person": ("person", "figure", "man"),
    "robot": ("robot", "android"),
    "snowman": ("snowman",),
    "duck": ("duck", "bird"),
    "turtle": ("turtle", "tortoise"),
    "fish": ("fish",),
    "vase": ("vase", "jar"),
    "mug": ("mug", "cup"),
    "pumpkin": ("pumpkin",),
    "ball": ("ball", "sphere"),
}
"""Synonyms a body; the first is the one that messages use."""

PART_WORDS: dict[str, tuple[str, ...]] = {
    "wings": ("wings", "two wings", "feathered wings", "a pair of wings", "two large wings"),
    "horn": ("a horn", "one horn", "a unicorn horn", "a pointed horn"),
    "antlers": ("antlers", "two antlers", "a pair of antlers"),
    "pointed hat": ("a pointed hat", "a wizard hat", "a party hat", "a witch hat", "a cone hat"),
    "top hat": ("a top hat", "a tall hat", "a black top hat", "a cylinder hat"),
    "crown": ("a crown", "a golden crown", "a royal crown"),
    "handle": ("a handle", "a round handle", "a curved handle"),
    "skateboard": ("a skateboard", "a wooden skateboard", "a board with wheels"),
    "horns": ("horns", "two horns", "bull horns", "a pair of horns", "curved horns"),
    "cape": ("a cape", "a cloak", "a red cape", "a long cape"),
    "tail": ("a tail", "a bushy tail", "a long tail", "a fluffy tail"),
    "glasses": ("glasses", "round glasses", "a pair of glasses", "spectacles"),
    "butterfly": ("a butterfly", "a big butterfly", "a butterfly on top"),
    "flower": ("a flower", "a daisy", "a big flower", "a flower on top"),
    "backpack": ("a backpack", "a rucksack", "a school bag"),
    "spikes": ("spikes", "a row of spikes", "spikes on its back", "large spikes"),
}
WORN = ("pointed hat", "top hat", "crown", "cape", "glasses", "backpack")
COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white")
MATERIALS: dict[str, tuple[str, ...]] = {
    "wood": ("wooden", "made of wood"),
    "gold": ("golden", "gold", "made of gold"),
    "silver": ("silver", "made of silver"),
    "stone": ("stone", "made of stone"),
    "plastic": ("plastic", "made of plastic"),
    "ceramic": ("ceramic", "porcelain", "made of ceramic"),
}
HELD_OUT = frozenset(
    {
        ("horse", "cape"),
        ("cat", "backpack"),
        ("snowman", "flower"),
        ("bear", "spikes"),
        ("dog", "horns"),
        ("deer", "butterfly"),
        ("person", "tail"),
        ("robot", "glasses"),
        ("mug", "butterfly"),
        ("cow", "spikes"),
        ("rabbit", "cape"),
        ("duck", "flower"),
        ("pig", "backpack"),
        ("cat", "glasses"),
    }
)
"""Pairs that training never shows, so that the evaluation can ask for combinations of known words."""
SYNONYM_WHOLES = {("horse", "wings"): ("pegasus", "winged horse"), ("horse", "horn"): ("unicorn",)}
ADJECTIVES = ("", "", "", "highly detailed", "cute", "small", "white", "brown", "beautiful", "realistic")
AZIMUTH_WORDS = ("azimuth0", "azimuth15", "azimuth30", "azimuth45", "azimuth60", "azimuth75")
CLOSEUP_WORD = "closeup"


def random_style(rng: np.random.Generator) -> str:
    """A colour word, or a material's adjective or "made of" phrase."""
    if rng.random() < 0.5:
        return COLOURS[rng.integers(len(COLOURS))]
    words = list(MATERIALS.values())[rng.integers(len(MATERIALS))]
    return words[rng.integers(len(words))]


def styled(phrase: str, style: str) -> str:
    """The part's phrase with a colour or material: "a crown", "golden" -> "a golden crown"."""
    if not style:
        return phrase
    if style.startswith("made of"):
        return f"{phrase} {style}"
    for article in ("a pair of ", "a row of ", "a ", "one ", "two "):
        if phrase.startswith(article):
            return f"{article}{style} {phrase.removeprefix(article)}"
    if phrase.startswith("an "):
        return f"{'an' if style[0] in 'aeiou' else 'a'} {style} {phrase.removeprefix('an ')}"
    return f"{style} {phrase}"


def caption(body: str, part: str | None, rng: np.random.Generator, style: str = "") -> str:
    """A sentence that names the body and, unless None, the part in a `style`, from templates with synonyms."""
    adjective = ADJECTIVES[rng.integers(len(ADJECTIVES))]
    body_word = BODY_WORDS[body][rng.integers(len(BODY_WORDS[body]))]
    subject = " ".join(w for w in ("a", adjective, body_word) if w)
    if part is None:
        return subject
    wholes = SYNONYM_WHOLES.get((body, part), ())
    part_word = styled(PART_WORDS[part][rng.integers(len(PART_WORDS[part]))], style)
    if wholes and not style and rng.random() < 0.3:
        whole = " ".join(w for w in ("a", adjective, wholes[rng.integers(len(wholes))]) if w)
        return whole if rng.random() < 0.5 else f"{whole} with {part_word}"
    links = ["with", "with", "that has"]
    if part in WORN:
        links += ["wearing", "wearing"]
    if part == "skateboard":
        links = ["on", "standing on", "riding", "with"]
    return f"{subject} {links[rng.integers(len(links))]} {part_word}"


def view_words(azimuth_deg: float, closeup: bool) -> str:
    """The camera words of a four-view mosaic: the bin of its first azimuth modulo 90, and whether it is close."""
    word = AZIMUTH_WORDS[int(azimuth_deg % 90 // 15)]
    return f"{word} {CLOSEUP_WORD}" if closeup else word


def word_lists() -> dict[str, dict | list[str]]:
    """The vocabulary as `guidance.vocabulary.Vocabulary` reads it: what a user may write in a prompt."""
    return listed_words(BODY_WORDS, PART_WORDS, SYNONYM_WHOLES, vocabulary())


def listed_words(
    bodies: Mapping[str, Sequence[str]],
    parts: Mapping[str, Sequence[str]],
    wholes: Mapping[tuple[str, str], Sequence[str]],
    words: Sequence[str],
) -> dict[str, dict | list[str]]:
    """`word_lists` of any vocabulary `words`; `wholes` maps (body, part) to words for both together."""
    phrases = {word for group in (*bodies.values(), *parts.values()) for word in group}
    return {
        "bodies": {name: list(group) for name, group in bodies.items()},
        "parts": {name: list(group) for name, group in parts.items()},
        "wholes": {whole: part for (_, part), group in wholes.items() for whole in group},
        "words": [word for word in words if word not in phrases | {*AZIMUTH_WORDS, CLOSEUP_WORD}],
    }


def vocabulary() -> list[str]:
    """Every word of every caption, sorted."""
    texts = [w for words in (*BODY_WORDS.values(), *PART_WORDS.values(), *SYNONYM_WHOLES.values()) for w in words]
    texts += [
        *ADJECTIVES,
        *AZIMUTH_WORDS,
        CLOSEUP_WORD,
        *COLOURS,
        *(word for words in MATERIALS.values() for word in words),
        "metal grey normal map colour picture",
        "a an the with that has wearing on standing riding and of its head",
        "side top back front view",
    ]
    return sorted({word for text in texts for word in text.split()})
