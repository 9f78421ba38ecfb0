"""Numbers of the settings, by what they measure, each with its range."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

# Every number has an upper bound, far above what makes sense: what lies beyond ends in an overflow, in more memory
# than there is or in a loop without end, hours later and in words that name no setting.
Fraction = Annotated[float, Field(ge=0, le=1)]
Weight = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
GuidanceScale = Annotated[float, Field(ge=0, le=1e4, allow_inf_nan=False)]
Length = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
"""In canonical units, in which the base's longest side is 1.8."""
Width = Annotated[float, Field(ge=1e-6, le=10, allow_inf_nan=False)]
"""A length that is divided by."""
Rate = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
Steps = Annotated[int, Field(ge=1, le=1_000_000)]
Views = Annotated[int, Field(ge=1, le=64)]
Samples = Annotated[int, Field(ge=1, le=4096)]
"""Samples a pixel."""
Points = Annotated[int, Field(ge=1, le=10_000_000)]
Levels = Annotated[int, Field(ge=1, le=32)]
Features = Annotated[int, Field(ge=1, le=16)]
Neurons = Annotated[int, Field(ge=1, le=1024)]
Cells = Annotated[int, Field(ge=1, le=1 << 20)]
"""Cells a side of one level of a hash grid."""
Range = tuple[float, float]
ModelName = Annotated[str, Field(max_length=1024, pattern=r"^[^\x00-\x1f\x7f]*$")]
"""A hub id, a folder or a file."""
MOST_SAMPLES = 2**32 - 1
"""What Dr.Jit can number in one array."""
MOST_TURNTABLE_PIXELS = 10**9
"""All frames of a turntable are in memory at once, three bytes a pixel."""
