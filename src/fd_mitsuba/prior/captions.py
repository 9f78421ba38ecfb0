"""What the built-in prior's training captions say, and so the words that it knows."""

from __future__ import annotations

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
}
WORN = ("pointed hat", "top hat", "crown")
SYNONYM_WHOLES = {("horse", "wings"): ("pegasus", "winged horse"), ("horse", "horn"): ("unicorn",)}
ADJECTIVES = ("", "", "", "highly detailed", "cute", "small", "white", "brown", "beautiful", "realistic")
AZIMUTH_WORDS = ("azimuth0", "azimuth15", "azimuth30", "azimuth45", "azimuth60", "azimuth75")
CLOSEUP_WORD = "closeup"


def caption(body: str, part: str | None, rng: np.random.Generator) -> str:
    """A sentence that names the body and, unless None, the part, from templates with synonyms."""
    adjective = ADJECTIVES[rng.integers(len(ADJECTIVES))]
    body_word = BODY_WORDS[body][rng.integers(len(BODY_WORDS[body]))]
    subject = " ".join(w for w in ("a", adjective, body_word) if w)
    if part is None:
        return subject
    wholes = SYNONYM_WHOLES.get((body, part), ())
    part_word = PART_WORDS[part][rng.integers(len(PART_WORDS[part]))]
    if wholes and rng.random() < 0.3:
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


def vocabulary() -> list[str]:
    """Every word of every caption, sorted."""
    texts = [w for words in (*BODY_WORDS.values(), *PART_WORDS.values(), *SYNONYM_WHOLES.values()) for w in words]
    texts += [
        *ADJECTIVES,
        *AZIMUTH_WORDS,
        CLOSEUP_WORD,
        "a an the with that has wearing on standing riding and of its head",
        "side top back front view",
    ]
    return sorted({word for text in texts for word in text.split()})
