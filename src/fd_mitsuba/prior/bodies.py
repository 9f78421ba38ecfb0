"""Procedural bodies, each with the anchors where parts grow; front is +z, up is +y, sizes are jittered by seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fd_mitsuba.conventions import BASE_LONGEST_SIDE
from fd_mitsuba.prior.primitives import Solid, box, ellipsoid, join, lathe, mirror_x, rotation, tube

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Body:
    """A base mesh in the canonical frame and where parts attach to it.

    Attributes:
        solid: the mesh, bounding box centred, longest side `BASE_LONGEST_SIDE`.
        head_top: the highest point of the head; `head_radius` is the head's half-width there.
        forehead: where a horn starts, `horn_direction` its unit direction.
        back: middle of the shoulders or upper back; `back_half_width` from there to the flank, `reach` a length
            that wings are measured by.
        side: a point on the +x flank; `side_height` the flank's usable height.
        bottom: y of the feet with the footprint's half lengths `foot_x`, `foot_z` about (0, bottom, `foot_centre_z`).
    """

    solid: Solid
    head_top: np.ndarray
    head_radius: float
    forehead: np.ndarray
    horn_direction: np.ndarray
    back: np.ndarray
    back_half_width: float
    reach: float
    side: np.ndarray
    side_height: float
    bottom: float
    foot_x: float
    foot_z: float
    foot_centre_z: float


def _finish(parts: list[Solid], **anchors) -> Body:
    solid = join(parts)
    low, high = solid.vertices.min(0), solid.vertices.max(0)
    centre, scale = (low + high) / 2, BASE_LONGEST_SIDE / (high - low).max()
    points = {"head_top", "forehead", "back", "side"}
    placed = {}
    for name, value in anchors.items():
        if name in points:
            placed[name] = (np.asarray(value, float) - centre) * scale
        elif name == "horn_direction":
            placed[name] = np.asarray(value, float) / np.linalg.norm(value)
        elif name == "bottom":
            placed[name] = (value - centre[1]) * scale
        elif name == "foot_centre_z":
            placed[name] = (value - centre[2]) * scale
        else:
            placed[name] = float(value) * scale
    return Body(Solid((solid.vertices - centre) * scale, solid.faces), **placed)


def _jitter(rng: np.random.Generator, value: float, share: float = 0.12) -> float:
    return value * (1 + share * rng.uniform(-1, 1))


def _quadruped(
    rng: np.random.Generator,
    *,
    leg: float,
    length: float,
    girth: float,
    neck: float,
    neck_tilt: float,
    head: float,
    muzzle: float,
    ear: float,
    tail: float,
    horns: float = 0.0,
) -> Body:
    """Barrel, four legs, neck, head with muzzle and ears, tail; lengths are shares of the barrel's half length."""
    leg, length, girth = _jitter(rng, leg), _jitter(rng, length), _jitter(rng, girth)
    neck, head, muzzle, ear, tail = (_jitter(rng, v) for v in (neck, head, muzzle, ear, tail))
    tilt = np.deg2rad(neck_tilt + rng.uniform(-8, 8))
    barrel_y = leg + girth * 0.8
    solids = [
        tube(
            [(0, barrel_y, -length), (0, barrel_y + 0.06 * girth, 0), (0, barrel_y + 0.1 * girth, length)],
            [girth * 0.95, girth * 0.9, girth],
        )
    ]
    thick = girth * rng.uniform(0.26, 0.36)
    spread = girth * 0.6
    for z in (-length * 0.95, length * 0.95):
        side = tube(
            [(spread, barrel_y, z), (spread, leg * 0.5, z + 0.03 * length), (spread, thick * 0.6, z)],
            [thick * 1.3, thick * 0.85, thick * 0.8],
        )
        solids += [side, mirror_x(side)]
    neck_base = np.array([0, barrel_y + 0.35 * girth, length * 1.05])
    neck_end = neck_base + neck * np.array([0, np.sin(tilt), np.cos(tilt)])
    solids.append(tube([neck_base, (neck_base + neck_end) / 2, neck_end], [girth * 0.66, girth * 0.5, head * 0.72]))
    droop = rotation(degrees_x=rng.uniform(10, 28))
    solids.append(ellipsoid(neck_end, (head * 0.8, head * 0.85, head), droop))
    forward = droop @ np.array([0, 0, 1.0])
    nose = neck_end + forward * (head * 0.7 + muzzle)
    solids.append(tube([neck_end + forward * head * 0.4, nose], [head * 0.62, head * 0.44]))
    for sign in (1, -1):
        root = neck_end + np.array([sign * head * 0.5, head * 0.6, -head * 0.1])
        solids.append(
            tube([root, root + np.array([sign * 0.25, 1, -0.1]) * ear], [head * 0.22, head * 0.07], flatten=0.6)
        )
    tail_base = np.array([0, barrel_y + girth * 0.6, -length - girth * 0.8])
    solids.append(
        tube(
            [tail_base, tail_base + (0, -tail * 0.4, -tail * 0.5), tail_base + (0, -tail, -tail * 0.6)],
            [girth * 0.18, girth * 0.16, girth * 0.1],
        )
    )
    top = neck_end + np.array([0, head * 0.82, -head * 0.1])
    return _finish(
        solids,
        head_top=top,
        head_radius=head * 0.8,
        forehead=neck_end + np.array([0, head * 0.72, head * 0.42]),
        horn_direction=(0, 0.85, 0.5),
        back=(0, barrel_y + girth * 0.75, length * 0.35),
        back_half_width=girth * 0.55,
        reach=length + girth,
        side=(girth * 0.95, barrel_y, 0),
        side_height=girth * 1.5,
        bottom=0.0,
        foot_x=spread + thick,
        foot_z=length * 0.95 + thick,
        foot_centre_z=0.0,
    )


def _species(**shape) -> Callable[[np.random.Generator], Body]:
    return lambda rng: _quadruped(rng, **shape)


def _upright(
    rng: np.random.Generator,
    *,
    head: float,
    torso: float,
    belly: float,
    leg: float,
    arm: float,
    ear: float,
    ear_width: float,
    boxy: bool = False,
    thick: float = 0.3,
) -> Body:
    """Legs, torso, arms and a round (or boxy) head on top."""
    head, torso, belly, leg, arm, ear = (_jitter(rng, v) for v in (head, torso, belly, leg, arm, ear))
    shape = box if boxy else ellipsoid
    hip = leg
    chest = hip + torso * 2
    head_y = chest + head * 0.86
    solids = [
        shape((0, hip + torso * 0.95, 0), (belly, torso * 1.1, belly * 0.8)),
        shape((0, head_y, head * 0.08), (head, head * (0.85 if boxy else 0.95), head * 0.92)),
    ]
    limb = belly * thick
    swing = rng.uniform(0.2, 0.9)
    for sign in (1, -1):
        x = sign * belly * 0.5
        solids.append(
            tube([(x, hip + torso * 0.3, 0), (x, limb * 0.8, 0), (x, limb * 0.7, limb)], [limb * 1.1, limb, limb])
        )
        shoulder = np.array([sign * belly * 0.82, chest - torso * 0.45, 0])
        hand = shoulder + arm * np.array([sign * np.sin(swing), -np.cos(swing), 0.25])
        solids.append(tube([shoulder, hand], [limb * 0.85, limb * 0.75]))
        if ear > 0:
            root = np.array([sign * head * 0.6, head_y + head * 0.62, 0])
            solids.append(
                tube(
                    [root, root + np.array([sign * 0.3, 1, 0]) * ear],
                    [ear_width * head, ear_width * head * 0.9],
                    flatten=0.6,
                )
            )
    solids.append(ellipsoid((0, head_y - head * 0.15, head * 0.92), (head * 0.3, head * 0.25, head * 0.28)))
    return _finish(
        solids,
        head_top=(0, head_y + head * (0.8 if boxy else 0.9), 0),
        head_radius=head * 0.85,
        forehead=(0, head_y + head * 0.62, head * 0.66),
        horn_direction=(0, 0.8, 0.6),
        back=(0, chest - torso * 0.5, -belly * 0.55),
        back_half_width=belly * 0.45,
        reach=torso * 1.6 + head * 0.4,
        side=(belly * 0.95, hip + torso * 0.9, 0),
        side_height=torso * 1.3,
        bottom=0.0,
        foot_x=belly * 0.5 + limb,
        foot_z=limb * 2.2,
        foot_centre_z=limb * 0.4,
    )


def _snowman(rng: np.random.Generator) -> Body:
    low, middle, head = _jitter(rng, 1.0, 0.08), _jitter(rng, 0.74, 0.08), _jitter(rng, 0.52, 0.08)
    middle_y = low * 0.86 + low * 0.55 + middle * 0.5
    head_y = middle_y + middle * 0.75 + head * 0.55
    solids = [
        ellipsoid((0, low * 0.86, 0), (low, low * 0.9, low)),
        ellipsoid((0, middle_y, 0), (middle,) * 3),
        ellipsoid((0, head_y, 0), (head,) * 3),
        tube([(0, head_y, head * 0.9), (0, head_y - 0.02, head * rng.uniform(1.4, 1.8))], [head * 0.16, head * 0.03]),
    ]
    if rng.random() < 0.7:
        arm = tube(
            [(middle * 0.8, middle_y + 0.1, 0), (middle * 1.9, middle_y + rng.uniform(0.2, 0.7), 0.1)], [0.07, 0.05]
        )
        solids += [arm, mirror_x(arm)]
    return _finish(
        solids,
        head_top=(0, head_y + head * 0.9, 0),
        head_radius=head * 0.85,
        forehead=(0, head_y + head * 0.7, head * 0.62),
        horn_direction=(0, 0.8, 0.6),
        back=(0, middle_y + middle * 0.3, -middle * 0.6),
        back_half_width=middle * 0.5,
        reach=middle * 1.6,
        side=(low * 0.95, low * 0.9, 0),
        side_height=low * 1.2,
        bottom=0.0,
        foot_x=low * 0.6,
        foot_z=low * 0.8,
        foot_centre_z=0.0,
    )


def _bird(rng: np.random.Generator) -> Body:
    body, head, neck = _jitter(rng, 0.6), _jitter(rng, 0.36), _jitter(rng, 0.45, 0.4)
    head_at = np.array([0, body * 1.2 + neck, body * 0.75])
    beak = _jitter(rng, 0.3, 0.3)
    solids = [
        ellipsoid((0, body, 0), (body * 0.8, body * 0.75, body * 1.2), rotation(-12)),
        tube([(0, body * 1.2, body * 0.6), head_at], [body * 0.45, head * 0.7]),
        ellipsoid(head_at, (head,) * 3),
        tube(
            [head_at + (0, -0.03, head * 0.8), head_at + (0, -0.06, head * 0.9 + beak)],
            [head * 0.34, head * 0.2],
            flatten=0.5,
        ),
        tube([(0, body * 1.15, -body * 0.9), (0, body * 1.6, -body * 1.6)], [body * 0.3, body * 0.12]),
    ]
    for x in (0.25, -0.25):
        solids.append(tube([(x, body * 0.4, 0.05), (x, 0.04, 0.1), (x, 0.04, 0.3)], [0.08, 0.08, 0.08]))
    return _finish(
        solids,
        head_top=head_at + (0, head * 0.9, 0),
        head_radius=head * 0.85,
        forehead=head_at + (0, head * 0.7, head * 0.6),
        horn_direction=(0, 0.8, 0.6),
        back=(0, body * 1.5, -body * 0.1),
        back_half_width=body * 0.5,
        reach=body * 1.7,
        side=(body * 0.75, body, 0),
        side_height=body,
        bottom=0.0,
        foot_x=0.33,
        foot_z=body * 0.8,
        foot_centre_z=0.1,
    )


def _turtle(rng: np.random.Generator) -> Body:
    shell, dome, head = _jitter(rng, 0.8), _jitter(rng, 0.42), _jitter(rng, 0.24)
    head_at = np.array([0, 0.5, shell * 1.35])
    solids = [
        ellipsoid((0, 0.38, 0), (shell * 0.85, dome, shell)),
        ellipsoid((0, 0.28, 0), (shell * 0.9, 0.12, shell * 1.04)),
        tube([(0, 0.3, shell * 0.8), head_at], [head * 0.6, head * 0.7]),
        ellipsoid(head_at, (head, head * 0.9, head * 1.2)),
    ]
    for z in (-0.6, 0.65):
        leg = tube([(shell * 0.55, 0.28, z * shell), (shell * 0.9, 0.1, z * shell * 1.15)], [0.15, 0.13])
        solids += [leg, mirror_x(leg)]
    return _finish(
        solids,
        head_top=head_at + (0, head * 0.8, 0),
        head_radius=head * 0.85,
        forehead=head_at + (0, head * 0.6, head * 0.7),
        horn_direction=(0, 0.8, 0.6),
        back=(0, 0.36 + dome * 0.9, 0),
        back_half_width=shell * 0.35,
        reach=shell * 1.2,
        side=(shell * 0.85, 0.36, 0),
        side_height=dome * 1.4,
        bottom=0.0,
        foot_x=shell * 0.8,
        foot_z=shell * 0.9,
        foot_centre_z=0.0,
    )


def _fish(rng: np.random.Generator) -> Body:
    long, tall, wide = _jitter(rng, 1.0), _jitter(rng, 0.5, 0.2), _jitter(rng, 0.3, 0.2)
    fin = _jitter(rng, 0.35)
    solids = [
        ellipsoid((0, 0, 0), (wide, tall, long)),
        tube([(0, 0, -long * 0.9), (0, fin, -long - fin)], [tall * 0.2, tall * 0.16], flatten=0.5),
        tube([(0, 0, -long * 0.9), (0, -fin, -long - fin)], [tall * 0.2, tall * 0.16], flatten=0.5),
    ]
    for sign in (1, -1):
        solids.append(ellipsoid((sign * wide * 0.72, tall * 0.25, long * 0.62), (0.06,) * 3))
    return _finish(
        solids,
        head_top=(0, tall * 0.82, long * 0.45),
        head_radius=wide * 0.75,
        forehead=(0, tall * 0.62, long * 0.68),
        horn_direction=(0, 0.7, 0.7),
        back=(0, tall * 0.7, 0),
        back_half_width=wide * 0.6,
        reach=long * 0.8,
        side=(wide * 0.97, 0, 0),
        side_height=tall,
        bottom=-tall,
        foot_x=wide,
        foot_z=long * 0.7,
        foot_centre_z=0.0,
    )


def _vessel(rng: np.random.Generator, profile: list[tuple[float, float]], swell: float) -> Body:
    """A solid of revolution; heights in [0, 2]. The head is its rim."""
    wide, tall = _jitter(rng, 1.0), _jitter(rng, 1.0)
    rows = [(r * wide * (1 + swell * rng.uniform(-1, 1)), y * tall) for r, y in profile]
    middle = int(np.argmax([r for r, _ in rows]))
    radius, height = max(r for r, _ in rows), rows[-1][1]
    rim = max(rows[-1][0], 0.2 * radius)
    waist = height * 0.5
    return _finish(
        [lathe(rows)],
        head_top=(0, height, 0),
        head_radius=max(rim, 0.35 * radius),
        forehead=(0, height * 0.97, rim * 0.6),
        horn_direction=(0, 0.8, 0.6),
        back=(0, height * 0.68, -radius * 0.75),
        back_half_width=radius * 0.4,
        reach=height * 0.5,
        side=(float(np.interp(waist, [y for _, y in rows], [r for r, _ in rows])), waist, 0),
        side_height=height * 0.6,
        bottom=0.0,
        foot_x=rows[0][0],
        foot_z=max(radius, rows[middle][0]) * 0.9,
        foot_centre_z=0.0,
    )


def _ball(rng: np.random.Generator) -> Body:
    squash = rng.uniform(0.85, 1.1)
    return _finish(
        [ellipsoid((0, squash, 0), (1, squash, 1))],
        head_top=(0, 2 * squash, 0),
        head_radius=0.6,
        forehead=(0, 1.8 * squash, 0.58),
        horn_direction=(0, 0.8, 0.6),
        back=(0, squash * 1.3, -0.75),
        back_half_width=0.5,
        reach=1.0,
        side=(1, squash, 0),
        side_height=1.2,
        bottom=0.0,
        foot_x=0.5,
        foot_z=0.8,
        foot_centre_z=0.0,
    )


BODIES: dict[str, Callable[[np.random.Generator], Body]] = {
    "horse": _species(
        leg=0.95, length=0.62, girth=0.36, neck=0.75, neck_tilt=52, head=0.22, muzzle=0.3, ear=0.16, tail=0.7
    ),
    "dog": _species(
        leg=0.6, length=0.5, girth=0.28, neck=0.34, neck_tilt=55, head=0.25, muzzle=0.2, ear=0.18, tail=0.35
    ),
    "cat": _species(
        leg=0.5, length=0.48, girth=0.25, neck=0.26, neck_tilt=45, head=0.27, muzzle=0.04, ear=0.18, tail=0.6
    ),
    "deer": _species(
        leg=1.0, length=0.52, girth=0.3, neck=0.65, neck_tilt=62, head=0.2, muzzle=0.22, ear=0.22, tail=0.15
    ),
    "cow": _species(
        leg=0.6, length=0.65, girth=0.42, neck=0.4, neck_tilt=30, head=0.27, muzzle=0.26, ear=0.14, tail=0.6
    ),
    "pig": _species(
        leg=0.34, length=0.5, girth=0.42, neck=0.26, neck_tilt=18, head=0.3, muzzle=0.16, ear=0.16, tail=0.12
    ),
    "bear": lambda rng: _upright(
        rng, head=0.46, torso=0.5, belly=0.5, leg=0.45, arm=0.6, ear=0.1, ear_width=0.24, thick=0.36
    ),
    "rabbit": lambda rng: _upright(
        rng, head=0.4, torso=0.42, belly=0.4, leg=0.34, arm=0.45, ear=0.6, ear_width=0.2, thick=0.32
    ),
    "person": lambda rng: _upright(rng, head=0.3, torso=0.45, belly=0.38, leg=0.95, arm=0.75, ear=0.0, ear_width=0.1),
    "robot": lambda rng: _upright(
        rng, head=0.38, torso=0.5, belly=0.52, leg=0.6, arm=0.75, ear=0.0, ear_width=0.1, boxy=True
    ),
    "snowman": _snowman,
    "duck": _bird,
    "turtle": _turtle,
    "fish": _fish,
    "vase": lambda rng: _vessel(
        rng, [(0.4, 0), (0.52, 0.2), (0.78, 0.8), (0.7, 1.2), (0.4, 1.6), (0.34, 1.8), (0.46, 2.0)], 0.08
    ),
    "mug": lambda rng: _vessel(
        rng, [(0.66, 0), (0.72, 0.06), (0.74, 0.6), (0.74, 1.2), (0.76, 1.62), (0.74, 1.66)], 0.03
    ),
    "pumpkin": lambda rng: _vessel(
        rng, [(0.3, 0.02), (0.8, 0.2), (1.0, 0.7), (0.95, 1.1), (0.6, 1.42), (0.16, 1.45), (0.12, 1.7)], 0.05
    ),
    "ball": _ball,
}
"""Every body word of the vocabulary and its maker."""
