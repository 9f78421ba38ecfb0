"""The documentation keeps its form, and what is generated from the code leaves nothing out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field

import fd_mitsuba
from fd_mitsuba.api import demo_scene
from fd_mitsuba.cli.main import command_parser, main
from fd_mitsuba.config import RunConfig, Section

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "tools"), str(ROOT / "tools" / "site")]

from commands_page import commands_page  # noqa: E402
from settings_page import descriptions, settings_page, table  # noqa: E402
from wrap_markdown import markdown_files, too_long, wrapped  # noqa: E402

SECTIONS = {
    name: field.annotation
    for name, field in RunConfig.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
}


@pytest.mark.parametrize("path", markdown_files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_lines_of_markdown_are_at_most_120_columns_wide(path: Path) -> None:
    """Rows of tables cannot be wrapped; those of the README are held short all the same."""
    text = path.read_text(encoding="utf-8")
    assert not too_long(text, tables=path == ROOT / "README.md"), "run tools/wrap_markdown.py"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_wrapping_keeps_words_code_tables_and_lists() -> None:
    long = "word " * 40
    text = (
        f"# Title\n\n{long}\nand `a code span` on.\n\n- item one\n- {long}\n  more\n\n    code {long}\n\n"
        f"| a | {long} |\n|---|---|\n\n```text\n{long}\n```\n"
    )
    laid = wrapped(text)
    assert laid.split() == text.split()
    lines = laid.split("\n")
    assert lines[:2] == ["# Title", ""] and f"    code {long}" in lines and f"| a | {long} |" in lines
    assert lines.count(long) == 1 and "- item one" in lines  # the fenced one; the paragraph was wrapped
    item = lines.index("- item one") + 1
    assert lines[item].startswith("- word") and lines[item + 1].startswith("  word")
    assert wrapped(laid) == laid
    assert too_long(laid) == [lines.index(f"    code {long}") + 1, lines.index(long) + 1]


@pytest.mark.parametrize("model", [RunConfig, *SECTIONS.values()])
def test_every_setting_has_a_description(model: type[Section]) -> None:
    settings = set(model.model_fields) - (set(SECTIONS) if model is RunConfig else set())
    assert settings and not settings - set(descriptions(model))


def test_the_settings_page_has_every_setting_with_its_range_and_values() -> None:
    page = settings_page()
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    outside = len(RunConfig.model_fields) - len(SECTIONS)
    assert len(rows) == outside + sum(len(model.model_fields) for model in SECTIONS.values())
    cells = next(line for line in rows if line.startswith("| `grid_resolution`"))
    assert cells.split(" | ")[1:5] == ["integer ≥ 8, ≤ 256", "`64`", "", ""]
    steps = next(line for line in rows if line.startswith("| `steps` | integer ≥ 1, ≤ 1000000 | `3000`"))
    assert steps.split(" | ")[3] == "`400`"


class MayChange:
    def __repr__(self) -> str:
        return "MAY_CHANGE"


class Marked(Section):
    pace: Annotated[int, Field(ge=1), MayChange()] = 3
    """How often."""
    shape: Literal["round", "flat"] | None = None
    """Which."""


def test_a_row_tells_values_meaning_and_whether_a_resumed_run_takes_another() -> None:
    rows = table(
        Marked, ["pace", "shape"], {"quick": {"pace": 3, "shape": "flat"}, "paper": {"pace": 5, "shape": None}}
    )
    assert rows.splitlines()[2:] == [
        "| `pace` | integer ≥ 1 | `3` |  | `5` | How often. May change on `--resume`. |",
        '| `shape` | `"round"` or `"flat"` or none | `none` | `"flat"` |  | Which. |',
    ]


def test_the_commands_page_has_every_command_and_option() -> None:
    page = commands_page()
    commands = next(action for action in command_parser()._actions if action.dest == "command").choices
    assert {"demo", "run", "export", "prior"} <= set(commands)
    for name, parser in commands.items():
        section = page.split(f"\n## fd_mitsuba {name}\n")[1].split("\n## ")[0]
        for action in parser._actions:
            assert all(f"`{option}`" in section for option in action.option_strings if option not in ("-h", "--help"))
    assert not [line for line in page.splitlines() if line.startswith("| `") and line.endswith("|  |")], "without help"


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_a_completion_script_names_the_commands(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--print-completion", shell])
    script = capsys.readouterr().out
    assert stop.value.code == 0 and all(word in script for word in ("instance", "print-completion", "texture-size"))
    if shell == "bash":
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)


def test_the_demo_scene_is_the_shipped_cat() -> None:
    shipped = ROOT / "scenes" / "cat"
    assert demo_scene().read_bytes() == (shipped / "scene.xml").read_bytes()
    named = ("cat.ply", "cat_base_color.png", "cat_roughness.png", "../lighting/city.exr", "../lighting/LICENSE")
    for name in named:
        assert (demo_scene().parent / name).read_bytes() == (shipped / name).read_bytes()


def test_the_version_stands_in_one_place() -> None:
    assert f"\n## {fd_mitsuba.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert 'dynamic = ["version"]' in project and '\nversion = "' not in project
