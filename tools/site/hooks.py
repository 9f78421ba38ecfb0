"""What `mkdocs build` does beside reading docs/: generated references, pages from elsewhere in the repository, links.

Pages keep the links that work where their file is read in the repository; here each link is moved to the place that its
target has on the site. A target that exists in the repository and not on the site becomes plain text; one that does
not exist at all stays, so that `--strict` reports it. No page may load anything from elsewhere.
"""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path
from typing import Any

from commands_page import commands_page
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from settings_page import settings_page

ROOT = Path(__file__).parents[2]
MOVED = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "src/fd_mitsuba/weights/MODEL_CARD.md": "model_card.md",
}
"""Files that have another place on the site than in the repository; docs/ is the site's root."""
PAGES = ("scenes/README.md", "scenes/*/README.md", "examples/*/README.md", "examples/*.ipynb")
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
ELSEWHERE = re.compile(r"""<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=["']?(?:https?:)?//[^>]*>""")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages and pictures that do not lie in docs/."""
    files.append(File.generated(config, "settings.md", content=settings_page()))
    files.append(File.generated(config, "commands.md", content=commands_page()))
    pages = [ROOT / name for name in MOVED] + [path for pattern in PAGES for path in sorted(ROOT.glob(pattern))]
    pictures = set()
    for path in pages:
        text = _notebook(path) if path.suffix == ".ipynb" else path.read_text(encoding="utf-8")
        source = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, _place(source), content=_relinked(text, source)))
        pictures |= {_target(source, link) for mark, _, link in LINK.findall(text) if mark and "://" not in link}
    for page in sorted((ROOT / "docs").glob("*.md")):
        links = LINK.findall(page.read_text(encoding="utf-8"))
        pictures |= {_target(f"docs/{page.name}", link) for mark, _, link in links if mark and "://" not in link}
    for picture in sorted(pictures):
        if not picture.startswith("docs/") and (ROOT / picture).is_file():
            files.append(File.generated(config, _place(picture), abs_src_path=str(ROOT / picture)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Move the links of the pages of docs/."""
    return markdown if page.file.generated_by else _relinked(markdown, f"docs/{page.file.src_uri}")


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Refuse a page that would load something from elsewhere."""
    for element in ELSEWHERE.findall(output):
        if 'rel="canonical"' not in element:
            raise PluginError(f"{page.file.src_uri}: loads from elsewhere: {element}")
    return output


def _place(source: str) -> str:
    """Where a file of the repository is on the site."""
    if source.endswith(".ipynb"):
        source = source.removesuffix(".ipynb") + ".md"
    return MOVED.get(source, source.removeprefix("docs/"))


def _target(source: str, link: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(source), link.split("#")[0]))


def _relinked(text: str, source: str) -> str:
    def moved(match: re.Match[str]) -> str:
        mark, label, link = match.groups()
        if "://" in link or link.startswith(("#", "mailto:")):
            return match[0]
        target, _, anchor = _target(source, link), *link.partition("#")[1:]
        if (ROOT / target).is_dir() and (ROOT / target / "README.md").is_file():
            target += "/README.md"
        on_site = target.startswith(("docs/", "scenes/", "examples/")) and target.endswith((".md", ".ipynb"))
        if not (on_site or target in MOVED or mark or target.startswith("docs/")) and (ROOT / target).exists():
            return label
        place = posixpath.relpath(_place(target), posixpath.dirname(_place(source)) or ".")
        return f"{mark}[{label}]({place}{'#' + anchor if anchor else ''})"

    return LINK.sub(moved, text)


def _notebook(path: Path) -> str:
    """A notebook's cells as Markdown; it is kept without outputs."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    blocks = [
        text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for cell, text in zip(cells, texts, strict=True)
    ]
    return "\n\n".join(blocks) + f"\n\nThis page is the notebook `{path.relative_to(ROOT)}`.\n"
