"""Mitsuba to the type checker: anything.

The stubs that Mitsuba ships are those of no one variant: its arrays and those of Dr.Jit's own stubs do not fit each
other (`mi.UInt32` is no `UInt` of `mi.sample_tea_32`), attributes such as `Ray3f.maxt` cannot be set, and what a plugin
returns is `object`. Checking against them found no fault and 90 false ones.
"""

from typing import Any

def __getattr__(name: str) -> Any: ...
