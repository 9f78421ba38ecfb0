"""What the documentation shows in Python runs: the blocks of docs/api.md, and the notebooks in examples/.

Both say `"quick"`, which takes minutes; here they run with the smoke settings and little else changed.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import nbformat
import pytest

import fd_mitsuba as fd

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
SMALLER = [
    "geometry.steps=2",
    "appearance.steps=2",
    "output.turntable_frames=2",
    "output.turntable_size=32",
    "output.picture_size=0",
    "output.texture_size=64",
    "output.faces=1000",
]


@pytest.fixture
def tiny_quick(tmp_path: Path) -> Path:
    """A folder to run in, whose `quick` is as small as it can be: a file of that name goes before the shipped one."""
    smoke = fd.Config.load("smoke", SMALLER).model_dump(mode="json", exclude_none=True)
    lines = [f"seed = {smoke.pop('seed')}"]
    for section, values in smoke.items():
        if isinstance(values, dict):
            lines += [f"[{section}]", *(f"{name} = {_toml(value)}" for name, value in values.items())]
    (tmp_path / "quick").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {_toml(inner)}" for name, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_blocks_of_the_python_page_run_in_order(tiny_quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = ROOT / "docs" / "api.md"
    text = page.read_text(encoding="utf-8")
    blocks = list(re.finditer(r"^```python\n(.*?)^```", text, re.M | re.S))
    assert len(blocks) >= 5
    monkeypatch.chdir(tiny_quick)
    names: dict[str, object] = {"__name__": "api_page"}
    for block in blocks:
        line = text[: block.start()].count("\n") + 1  # so that a traceback names the line of the page
        exec(compile("\n" * line + block[1], str(page), "exec"), names)
    assert (tiny_quick / "runs" / "crown" / "report.html").is_file() and (tiny_quick / "crown.stl").is_file()
    assert isinstance(names["run"], fd.Run) and names["run"].folder.name == "upwards"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_notebook_runs(path: Path, tiny_quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(Path(fd.__file__).parents[1]))
    monkeypatch.setenv("MPLBACKEND", "agg")
    notebook = nbformat.read(path, as_version=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the client's own, about event loops
        NotebookClient(notebook, timeout=500, resources={"metadata": {"path": str(tiny_quick)}}).execute()
    assert list((tiny_quick / "runs").glob("*/metrics.json"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_kept_small_and_without_outputs(path: Path) -> None:
    cells = nbformat.read(path, as_version=4).cells
    assert path.stat().st_size < 20_000
    code = [cell for cell in cells if cell.cell_type == "code"]
    assert code and all(not cell.outputs and cell.execution_count is None for cell in code)


def test_there_are_three_notebooks() -> None:
    assert {path.stem for path in NOTEBOOKS} >= {"first_edit", "own_guidance", "reading_a_run"}
