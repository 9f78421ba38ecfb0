"""Text-driven, part-wise 3D editing on Mitsuba 3: a new part grows where the scene says, the base stays as it is."""

__version__ = "0.1.0"
