"""Axes, units and signs that every module shares: words and constants, no logic.

Frame
    Right-handed, +y up; an object at azimuth 0 looks at the camera along +z.
    Azimuth grows towards +x (a camera at azimuth 90 sits on +x), elevation towards +y; both in degrees.
    *User frame*: the coordinates of the scene file. *Canonical frame*: the base's bounding box is centred on the
    origin and its longest side is `BASE_LONGEST_SIDE`; fields, losses and cameras live there. Where a region would
    stand out of the grid, base and regions together are centred, and the base is smaller (`scene.headroom`).
Signed distance
    Inside is **positive**, everywhere. A library that says otherwise is converted where it is called.
Normals
    Unit length, multiplied by coverage where they are stored in a picture. In *camera space* x is right, y is up
    and z points at the viewer, so a surface that faces the camera has (0, 0, 1).
Pictures
    (views, channels, height, width), row 0 at the top. A geometry picture has the channels of `GEOMETRY_CHANNELS`.
Colour
    Linear inside; sRGB in [0, 1] for files and for diffusion models.
"""

from __future__ import annotations

from typing import Literal, get_args

BASE_LONGEST_SIDE = 1.8
"""Longest side of the base's bounding box in the canonical frame (paper's data; the grid leaves room around it)."""

GRID_HALF_EXTENT = 1.05
"""The tetrahedral grid covers the cube [-1.05, 1.05]^3 of the canonical frame."""

GEOMETRY_CHANNELS = ("normal_x", "normal_y", "normal_z", "mask", "part_mask")
"""Channels of a geometry picture: normal times coverage in [-1, 1], then two coverages in [0, 1]."""

TextureChannel = Literal["base_color", "roughness", "metallic", "normal"]
TEXTURE_CHANNELS: tuple[TextureChannel, ...] = get_args(TextureChannel)
"""What a texture field says at a point: kd, the two of krm, kn."""

Weighting = Literal["sds", "uniform", "fantasia3d", "inverse", "ism"]
"""Names of w(t); `guidance.sds.weight` has the formulas."""

NormalAugmentation = Literal["none", "rotation", "rotation_flip"]
"""Random turns of the coarse phase's normals; `guidance.normal_augmentation` has them."""

NormalSpace = Literal["camera", "world"]
"""Frame of the normals in a picture; `world` is the canonical frame."""

STAGES = ("geometry", "appearance")
"""The stages of a run, in their order."""

BASE_NAME = "base"
DEFAULT_PART_NAME = "part"
