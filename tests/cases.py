"""Small inputs that once failed, kept under `tests/data/cases`."""

from __future__ import annotations

from pathlib import Path

CASES = Path(__file__).resolve().parent / "data" / "cases"
"""A folder for each kind of failure, with the scene files and what they read."""
