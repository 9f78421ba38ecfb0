"""Names, links and lines from whatever text comes from outside."""

from __future__ import annotations

import html.parser
import re
from urllib.parse import unquote, urljoin, urlsplit

from hypothesis import given
from hypothesis import strategies as st

from fd_mitsuba.errors import printable
from fd_mitsuba.io.safe_text import harmless_file_name, quoted_link, safe_name

ANYTHING = st.text(st.characters(exclude_categories=()), max_size=300)


@given(ANYTHING, st.sampled_from(["", ".png", ".ply"]))
def test_a_name_is_a_name(text: str, suffix: str) -> None:
    name = safe_name(text, suffix=suffix)
    assert re.fullmatch(r"\w[\w.-]*", name) and name.endswith(suffix)
    assert "/" not in name and len(name.encode()) < 255 and name not in (".", "..")


@given(ANYTHING)
def test_a_file_name_from_outside_stays_in_its_folder(text: str) -> None:
    name = harmless_file_name(text)
    assert name.isprintable() and not set(name) & set('/\\:*?"<>|') and name[0] not in ".- "
    assert 0 < len(name.encode()) < 255


def test_a_harmless_file_name_stays_as_others_refer_to_it() -> None:
    for name in ("oak wood.png", "Übergrößen (2).mtl", "木.jpg", "a--b;c.obj"):
        assert harmless_file_name(f"C:\\models/{name}") == name
    assert harmless_file_name("../.profile") == "_profile" and harmless_file_name("nul.png") == "_nul.png"
    assert harmless_file_name("a\nb.obj") == "a_b.obj" and harmless_file_name("") == "_"


@given(st.lists(ANYTHING, max_size=8))
def test_names_differ_where_case_does_not_count(texts: list[str]) -> None:
    names: list[str] = []
    for text in texts:
        names.append(safe_name(text, names))
    assert len({name.lower() for name in names}) == len(names)


def test_known_names() -> None:
    assert safe_name("Körper links") == "Körper_links"
    assert safe_name("Foot/left 1", {"foot_left_1"}) == "Foot_left_1_2"
    assert safe_name("../../../../escaped") == "__.._.._.._escaped"
    assert safe_name("base_color", {"BASE_COLOR.png"}, ".png") == "base_color_2.png"
    assert safe_name("nul.txt") == "_nul.txt" and safe_name("") == "_" and safe_name("-rf") == "_rf"
    assert safe_name("usual-name_1.x") == "usual-name_1.x"


@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=50))
def test_a_link_leads_to_the_file_and_nowhere_else(folder: str) -> None:
    name = folder.replace("/", "")
    link = quoted_link(f"{name}/report.html")
    page = html.parser.HTMLParser()
    found: list[str] = []
    page.handle_starttag = lambda tag, attributes: found.append(dict(attributes)["href"])  # type: ignore[method-assign]
    page.feed(f'<a href="{link}">')
    assert found == [link]
    whole = urlsplit(urljoin("file:///home/page.html", link))
    assert whole.scheme == "file" and not whole.query and not whole.fragment
    if name not in (".", ".."):
        assert unquote(whole.path) == (f"/home/{name}/report.html" if name else "/report.html")


def test_a_script_is_no_link() -> None:
    assert quoted_link("javascript:alert(1)/report.html") == "javascript%3Aalert%281%29/report.html"


@given(ANYTHING)
def test_a_line_prints_only_what_is_seen(text: str) -> None:
    line = printable(text)
    assert not re.search("[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\u2028\u2029\ud800-\udfff]", line)


def test_usual_text_stays_as_it_is() -> None:
    for text in ("a cat with a crown", "une chèvre à cornes", "猫と王冠", "a 👩‍🚀 cat"):
        assert printable(text) == text
    assert printable("\x1b]0;x\x07") == r"\x1b]0;x\x07" and printable("a\udce4") == r"a\udce4"
