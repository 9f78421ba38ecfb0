"""The caption that a model gets for what was understood, in the forms of its training.

Words of the prompt that the model was trained with stay as they are, so that a prompt in its own words comes out
unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fd_mitsuba.guidance.phrase_groups import Group
from fd_mitsuba.guidance.prompt_tokens import Token
from fd_mitsuba.guidance.vocabulary import WITHOUT, Vocabulary, article_of, bare
from fd_mitsuba.guidance.word_table import WordTable

_LINKS = (("with",), ("that", "has"))
_WORN_LINKS = (("wearing",),)
_RIDDEN_LINKS = (("on",), ("standing", "on"), ("riding",))


class CaptionWriter:
    """Writes one caption and remembers which tokens of the prompt went into it.

    Args:
        negated: tokens whose colours and materials do not count.

    Attributes:
        used: positions of the tokens that the caption says in some way.
        styles: names of the parts' colours and materials, as they come.
    """

    def __init__(
        self, vocabulary: Vocabulary, table: WordTable, tokens: Sequence[Token], negated: Iterable[int]
    ) -> None:
        self._vocabulary, self._table, self._tokens = vocabulary, table, tokens
        self._known = vocabulary.known_words()
        self._negated = frozenset(negated)
        self.used: set[int] = set()
        self.styles: list[str] = []

    def caption(self, body: Group | None, name: str | None, parts: Sequence[Group]) -> str:
        """ "a brown dog wearing a golden crown"; further parts follow after "and".

        Args:
            body: where the prompt says the body, if it does; a whole such as "unicorn" counts as one.
            name: the body's; None: a neutral word.
            parts: at least one, or none where the body is a whole.
        """
        words = [self._part(part) for part in parts]
        subject = self._body(body, name)
        return f"{subject} {self._link(body, parts[0])} {' and '.join(words)}" if parts else subject

    def removal(self, body: Group | None, name: str | None, parts: Sequence[Group]) -> str:
        """ "a brown dog without a crown"; what the parts look like is not told.

        Args:
            body, name: as of `caption`.
            parts: at least one.
        """
        words = [self._part(part, looks=False) for part in parts]
        return f"{self._body(body, name)} {WITHOUT} {' and '.join(words)}"

    def _body(self, group: Group | None, name: str | None) -> str:
        noun = self._noun(name)
        if group is None:
            return f"a {noun}"
        if group.entry.known:
            self.used |= set(range(group.first, group.behind))
        kept = []
        for place in group.modifiers:
            text = self._tokens[place].text
            style = None if place in self._negated else self._table.style_of(text, self._known)
            if style is not None or (text in self._table.adjectives and text in self._known):
                kept.append(text if style is None else style[0])
                self.used.add(place)
        kept += [self._adjective(name) for _, name in self._made_of(group)]
        return " ".join(["a", *kept, group.entry.phrase or noun])

    def _noun(self, name: str | None) -> str:
        if name is not None:
            return self._vocabulary.bodies[name][0]
        nouns = [noun for phrases in self._vocabulary.bodies.values() for noun in phrases]
        return next((noun for noun in self._table.neutral if noun in nouns), nouns[0])

    def _part(self, group: Group, looks: bool = True) -> str:
        phrases = self._vocabulary.parts[group.entry.name]
        self.used |= set(range(group.first, group.behind))
        if group.entry.kind != "part":
            return phrases[0]
        noun = group.entry.phrase
        own = set() if noun is None else {word for phrase in phrases for word in bare(phrase).split()} - {"on", "with"}
        kept = []
        for place in group.modifiers:
            text = self._tokens[place].text
            style = None if place in self._negated or not looks else self._table.style_of(text, self._known)
            if style is not None or text in own:
                kept.append(text if style is None else style[0])
                self.used.add(place)
                self.styles += [] if style is None else [style[1]]
        if noun is not None and looks:
            self.styles += [s[1] for word in noun.split() if (s := self._table.style_of(word, self._known))]
        article = self._article(group, phrases, kept)
        said = [*kept, noun if noun is not None else bare(phrases[0])]
        behind = [name for _, name in self._made_of(group)] if looks else []
        self.styles += behind
        if len(behind) == 1 and behind[0] in self._table.materials and {"made", "of", *behind} <= self._known:
            return f"{article}{' '.join(said)} made of {behind[0]}"
        return article + " ".join([*map(self._adjective, behind), *said])

    def _made_of(self, group: Group) -> list[tuple[str, str]]:
        """`style_of` for the words behind the noun."""
        found = []
        for place in range(group.end - len(group.made_of), group.end):
            style = self._table.style_of(self._tokens[place].text, self._known)
            if style is not None and place not in self._negated:
                found.append(style)
                self.used.add(place)
        return found

    def _article(self, group: Group, phrases: Sequence[str], kept: Sequence[str]) -> str:
        said = f"{group.determiner} " if group.determiner else ""
        if group.entry.phrase is None:
            return article_of(phrases[0])
        if said in {article_of(phrase) for phrase in phrases}:
            return said
        # The longest phrase of what is said: "the pointed hat" is "a pointed hat" as the model was told.
        words = {*kept, *group.entry.phrase.split()}
        like = [phrase for phrase in phrases if set(bare(phrase).split()) <= words]
        return article_of(max(like, key=lambda phrase: len(bare(phrase).split())) if like else phrases[0])

    def _link(self, body: Group | None, part: Group) -> str:
        name = part.entry.name
        links = _LINKS + (_WORN_LINKS if name in self._table.worn else ())
        links = _RIDDEN_LINKS + _LINKS if name in self._table.ridden else links
        if body is not None:
            between = [token.text for token in self._tokens[body.end : part.begin]]
            said = tuple(word for word in between if word in self._table.function or word == ",")
            if said in links:
                return " ".join(said)
        return " ".join(links[0])

    def _adjective(self, style: str) -> str:
        others = self._table.materials.get(style)
        return style if others is None else others[0]
