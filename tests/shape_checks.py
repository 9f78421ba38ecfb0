"""What checks annotations while the tests run: beartype, for which an int is a float, as it is for Python."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
PLACES = tuple(
    f"fd_mitsuba.{name}"
    for name in ("losses", "fields", "extraction", "guidance.sds", "guidance.mosaic", "guidance.colour_latents")
)
"""Packages and modules whose annotations carry shapes, and in which nothing is called so often that it would show."""
