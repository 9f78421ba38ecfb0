"""Where a body's surface is: what worn parts are fitted to."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, head_size
from fd_mitsuba.prior.data.fine.shapes import frame_towards, unit
from fd_mitsuba.prior.pictures.corpus import RayCaster

_FAR = 3.0
_BESIDE = np.array([1.3e-5, 0.7e-5, 0.4e-5])


class Surface:
    """A body with rays: every question returns surface points, or a stated guess where nothing is hit.

    Attributes:
        size: what head-worn parts are measured by.
        head: the middle of the head.
    """

    def __init__(self, body: Body) -> None:
        self.body, self.caster = body, RayCaster(body.solid)
        self.size = head_size(body)
        self.head = body.head_top - np.array([0, 0.95 * body.head_radius, 0])

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First surface points (N, 3) of rays, and whether (N,) there is one; without, the points mean nothing."""
        directions = unit(np.broadcast_to(np.asarray(directions, float), origins.shape))
        distance, _ = self.caster.cast(origins + _BESIDE, directions)
        hit = np.isfinite(distance)
        return origins + np.where(hit, distance, 0.0)[:, None] * directions, hit

    def towards(self, through: np.ndarray, direction: tuple[float, float, float]) -> np.ndarray:
        """First surface points (N, 3) of rays that come from far away through points (N, 3); those where they miss."""
        through = np.atleast_2d(np.asarray(through, float))
        ray = unit(np.asarray(direction, float))
        origins = through - ray * (through @ ray + _FAR)[:, None]
        points, hit = self.cast(origins, ray)
        return np.where(hit[:, None], points, through)

    def ring(
        self, centre: np.ndarray, axis: np.ndarray | tuple, reach: float, count: int = 24, spread: float = 1.5
    ) -> np.ndarray:
        """Surface points (count, 3) around an axis, looked for from `reach` inwards; the first lies towards +z.

        Radii are kept within `spread` times their median, so that an ear or an arm does not bulge a collar.
        """
        turn = frame_towards(axis)
        angle = np.arange(count) * (2 * np.pi / count)
        out = np.stack([np.sin(angle), np.zeros(count), np.cos(angle)], 1) @ turn.T
        points, hit = self.cast(centre + out * reach, -out)
        radius = np.where(hit, ((points - centre) * out).sum(1), np.nan)
        radius = np.where(radius > 0.02, radius, np.nan)
        middle = np.nanmedian(radius) if np.isfinite(radius).any() else 0.5 * reach
        radius = np.clip(np.where(np.isfinite(radius), radius, middle), middle / spread, middle * spread)
        smooth = (np.roll(radius, 1) + 2 * radius + np.roll(radius, -1)) / 4
        return centre + out * smooth[:, None]

    def seat(self, radius: float) -> np.ndarray:
        """Where the middle of a ring of that radius comes to rest when it is put on the head from above."""
        top = self.body.head_top
        angle = np.arange(16) * (np.pi / 8)
        origins = top + np.stack([radius * np.sin(angle), np.full(16, 1.2), radius * np.cos(angle)], 1)
        points, hit = self.cast(origins, np.array([0, -1.0, 0]))
        lowest = top[1] - 0.55 * self.size
        height = np.where(hit, points[:, 1], lowest)
        return np.array([top[0], float(np.clip(np.quantile(height, 0.7), lowest, top[1])), top[2]])

    def neck(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Middle of the neck, its unit direction towards the head, and how far out to look for its skin."""
        body, radius = self.body, self.body.head_radius
        if body.upright:
            height = max(body.head_top[1] - 2.1 * radius, body.back[1] + 0.12 * body.side_height)
            return np.array([0, height, self.head[2]]), np.array([0, 1.0, 0]), 1.6
        shoulders = body.back - np.array([0, 0.5 * body.side_height, -0.1])
        axis = self.head - shoulders
        axis[0] = 0
        return shoulders + 0.64 * axis, unit(axis), 0.75

    def mouth(self) -> np.ndarray:
        """The point (3,) on the front of the head below the eyes."""
        low = np.array([[0, self.head[1] - 0.35 * self.body.head_radius, 0]])
        return self.towards(low, (0, 0, -1))[0]

    def feet(self) -> list[tuple[np.ndarray, float]]:
        """Middle of each foot's sole and its half-width; empty for bodies that stand on their belly."""
        body = self.body
        half_x, half_z = max(body.foot_x, 0.1) * 1.3, max(body.foot_z, 0.1) * 1.3
        x, z = np.meshgrid(np.linspace(-half_x, half_x, 28), np.linspace(-half_z, half_z, 28))
        origins = np.stack([x.ravel(), np.full(x.size, body.bottom - 1.0), z.ravel() + body.foot_centre_z], 1)
        points, hit = self.cast(origins, np.array([0, 1.0, 0]))
        sole = points[hit & (points[:, 1] < body.bottom + 0.09)]
        feet = []
        for sign_x in (1, -1):
            side = sole[sole[:, 0] * sign_x > 0.015]
            if len(side) < 3:
                continue
            long = np.ptp(side[:, 2])
            groups = [side]
            if long > 0.9 * half_z:
                middle = (side[:, 2].max() + side[:, 2].min()) / 2
                groups = [side[side[:, 2] > middle], side[side[:, 2] <= middle]]
            for group in groups:
                if len(group) >= 2:
                    centre = (group.min(0) + group.max(0)) / 2
                    feet.append((np.array([centre[0], body.bottom, centre[2]]), max(np.ptp(group[:, 0]) / 2, 0.05)))
        return feet
