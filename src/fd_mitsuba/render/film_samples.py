"""The random numbers of a picture: functions of seed, pixel and sample alone, so that nothing else can shift them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

_UNIT = 2.0**-24
_KRONECKER = tuple(int((1.1347241384015194**-power % 1.0) * 2**32) for power in range(1, 6))
"""Fractions of powers of the root of x^6 = x + 1: five dimensions of an additive recurrence that fills evenly."""

_SALTS = (0x9E3779B9, 0x3C6EF372, 0xDAA66D2B)


def opaque_seed(seed: int) -> mi.UInt32:
    """A seed that is data to the kernels, so that a new one compiles nothing."""
    return dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)


def film_position(pixel: mi.UInt32, sample: mi.UInt32, spp: int, size: int, seed: mi.UInt32) -> mi.Point2f:
    """Where in a picture of `size` x `size` pixels a sample lies: a Hammersley set in every pixel, shifted at random.

    Args:
        pixel: row times `size` plus column.
        sample: 0 to `spp` - 1.
        seed: another one for every view.
    """
    shift = mi.sample_tea_32(seed, pixel)
    x = sample * ((2**32 - 1) // spp) + shift[0]
    y = dr.brev(sample) + shift[1]
    return mi.Point2f(mi.Float(pixel % size) + _unit(x), mi.Float(pixel // size) + _unit(y))


@dataclass(frozen=True)
class LightNumbers:
    """What the choice of a light and of a reflected direction takes, each uniform in [0, 1)."""

    emitter: mi.Point2f
    lobe: mi.Float
    direction: mi.Point2f


def light_numbers(pixel: mi.UInt32, sample: mi.UInt32, seed: mi.UInt32) -> LightNumbers:
    """An additive recurrence in every pixel, shifted at random: uniform, and its samples keep apart."""
    shifts = [value for salt in _SALTS for value in mi.sample_tea_32(seed ^ salt, pixel)]
    values = [_unit(sample * step + shift) for step, shift in zip(_KRONECKER, shifts, strict=False)]
    return LightNumbers(mi.Point2f(values[0], values[1]), values[2], mi.Point2f(values[3], values[4]))


def _unit(bits: mi.UInt32) -> mi.Float:
    return mi.Float(bits >> 8) * _UNIT
