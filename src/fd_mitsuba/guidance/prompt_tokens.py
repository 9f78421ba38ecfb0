"""A prompt as a list of lower-case words and stops: hyphens, apostrophes and short forms are resolved here."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

_SHORT_FORMS = (
    (r"\bw/o\b", " without "),
    (r"\bw/", " with "),
    (r"\bcan'?t\b|\bcannot\b", " can not "),
    (r"\bwon't\b", " will not "),
    (r"n't\b", " not "),
    (r"[&+]", " and "),
    (r"\b2\b", " two "),
    (r"\b3\b", " three "),
    (r"\b4\b", " four "),
)
_OTHER_FORMS = {"'": "’‘ʼ`´", "-": "‐‑–—", '"': "“”"}


@dataclass(frozen=True)
class Token:
    """Attributes:
    text: a word in lower case, or one of the stops `,` and `.`.
    owner: whether it was a possessive: "wizard's" is the owner "wizard".
    """

    text: str
    owner: bool = False

    @property
    def is_stop(self) -> bool:
        """Whether it is a punctuation mark."""
        return self.text in ",."


def tokens_of(prompt: str) -> list[Token]:
    """Words and stops of a prompt, in order. "A wizard's top-hat, w/o wings!" -> a wizard('s) top hat , without wings .

    Case, hyphens and accents do not count; `;`, `:`, `!`, `?` and brackets are stops as a full stop and a comma are.
    """
    text = prompt.lower()
    for plain, others in _OTHER_FORMS.items():
        text = re.sub(f"[{others}]", plain, text)
    text = "".join(letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    for pattern, words in _SHORT_FORMS:
        text = re.sub(pattern, words, text)
    found = []
    for word in re.findall(r"[^\W_]+(?:'s\b|s'(?!\w))?|[,.;:!?()\[\]]", text):
        if not word[0].isalnum():
            found.append(Token("," if word in ",()[]" else "."))
        elif word.endswith("'s"):
            found.append(Token(word[:-2], True))
        elif word.endswith("s'"):
            found.append(Token(word[:-2], True))
        else:
            found.append(Token(word))
    return found
