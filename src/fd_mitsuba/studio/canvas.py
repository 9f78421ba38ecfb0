"""The 3D side of the page: base and part, the regions with their gizmo, the light. All in the canonical frame.

In that frame every base is about two units long, so that gizmo, camera and grid need no scale of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.shown_objects import ShownObjects

if TYPE_CHECKING:
    import viser

CAMERA, FOV_DEG = (2.3, 1.6, 3.75), 40.0
"""Where a tab looks from at first, towards the origin: it sees the whole cube."""
GIZMO_SCALE = 0.42
OWN_LIGHT = "the scene's"
LIGHTS: dict[str, Any] = {
    OWN_LIGHT: None,
    "city": "city",
    "photo studio": "studio",
    "hall": "lobby",
    "forest": "forest",
    "sunset": "sunset",
    "night": "night",
}
"""What the page calls an environment map -> its name among those of viser."""
_COLOURS = [(242, 142, 43), (78, 121, 167), (89, 161, 79), (176, 122, 161), (225, 87, 89), (118, 183, 178)]
_LINES = (60, 60, 60)
_GLASS, _FAINT_GLASS = 0.35, 0.1
"""Opacity of a region, and of one whose part is shown."""


class Canvas:
    """Draws; knows nothing of runs or prompts. Every method replaces what was there before.

    Args:
        server: viser's.
        on_region: hears the name of a region that was clicked.
        on_gizmo: hears the gizmo's position and quaternion while it is dragged, canonical frame.
        on_base: hears origin and direction of a click on the base while `picking`.

    Attributes:
        objects: base, part, and a result beside them.
        visible: what is to be seen; call `apply_visibility` after a change.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        on_region: Callable[[str], None],
        on_gizmo: Callable[[np.ndarray, np.ndarray], None],
        on_base: Callable[[Any], None],
    ) -> None:
        self.server, self._scene = server, server.scene
        self._on_region, self._on_gizmo, self._on_base = on_region, on_gizmo, on_base
        self._regions: dict[str, Any] = {}
        self._clickable: set[str] = set()
        self._meshes: set[str] = set()
        self._gizmo: Any = None
        self.visible = {"base": True, "part": True, "regions": True, "wireframe": False, "grid": True}
        self.objects = ShownObjects(server, self.visible)
        self._scene.set_up_direction("+y")
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up = CAMERA, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
        camera.fov = float(np.radians(FOV_DEG))
        half = np.full(3, GRID_HALF_EXTENT)
        self.show_grid(-half, half)

    def show_grid(self, low: np.ndarray, high: np.ndarray) -> None:
        """The box (3,) to (3,) in which a part can grow, canonical frame."""
        box = (low + high) / 2 + (high - low) / 2 * _box_edges()
        self._grid = self._scene.add_line_segments(
            "/grid", box, _LINES, thickness=1.0, thickness_units="screen", visible=self.visible["grid"]
        )

    def picking(self, wanted: bool) -> None:
        """Whether a click on the base is heard."""
        self.objects.picking(self._on_base if wanted else None)

    def set_light(self, name: str, own: bytes | None) -> None:
        """One of `LIGHTS` instead of the one before, for every tab.

        Args:
            own: the scene's, as a JPEG with a gain map; None: it has none to show, and the page's own stands in.
        """
        from viser._messages import EnvironmentMapMessage

        alone = name == OWN_LIGHT and own is not None
        with self.server.atomic():
            self._scene.configure_default_lights(not alone)  # viser's two lamps
            if alone:
                nowhere, upright = (0.0, 1.0), (1.0, 0.0, 0.0, 0.0)
                message = EnvironmentMapMessage(own, False, *nowhere, upright, 1.0, upright)
                self._scene._websock_interface.queue_message(message)  # takes presets alone otherwise
            else:
                self._scene.configure_environment_map(LIGHTS[name] or "city")

    def show_regions(self, poses: Sequence[EllipsoidPose], meshes: Sequence[FocalRegion], frame: Normalisation) -> None:
        """All regions as glass; the gizmo stays as it is."""
        with self.server.atomic():
            for handle in self._regions.values():
                handle.remove()
            self._regions, self._clickable = {}, set()
            for number, pose in enumerate(poses):
                self._regions[pose.name] = handle = self._scene.add_icosphere(
                    f"/regions/{number}",
                    radius=1.0,
                    subdivisions=3,
                    color=region_colour(number),
                    opacity=self._glass,
                    side="double",
                    cast_shadow=False,
                    receive_shadow=False,
                )
                self.place_region(pose, frame)
            self._meshes = {region.name for region in meshes}
            for number, region in enumerate(meshes):
                surface = region.surface()
                self._regions[region.name] = self._scene.add_mesh_simple(
                    f"/region_meshes/{number}",
                    surface.vertices,
                    surface.faces,
                    color=(150, 150, 150),
                    opacity=0.35,
                    side="double",
                )
            self.apply_visibility()

    def place_region(self, pose: EllipsoidPose, frame: Normalisation) -> None:
        """Put one ellipsoid where it is now."""
        handle = self._regions.get(pose.name)
        if handle is None:
            return
        handle.position, handle.wxyz = frame.to_canonical(np.array(pose.centre)), np.array(pose.wxyz)
        handle.scale = tuple(frame.scale * radius for radius in pose.radii)

    def show_gizmo(self, pose: EllipsoidPose | None, frame: Normalisation) -> None:
        """The gizmo of the region that is selected; None: none."""
        self._let_click(None if pose is None else pose.name)
        if pose is None:
            if self._gizmo is not None:
                self._gizmo.visible = False
            return
        if self._gizmo is None:
            self._gizmo = self._scene.add_transform_controls("/gizmo", scale=GIZMO_SCALE, depth_test=False)

            # `async`, so that poses are taken in the order in which they come.
            async def moved(event: Any) -> None:
                self._on_gizmo(np.array(event.target.position), np.array(event.target.wxyz))

            self._gizmo.on_update(moved)
        self._gizmo.position, self._gizmo.wxyz = frame.to_canonical(np.array(pose.centre)), np.array(pose.wxyz)
        self._gizmo.visible = self.visible["regions"]

    def _let_click(self, selected: str | None) -> None:
        """Every ellipsoid but the selected one can be clicked: that one would take the clicks that are for its gizmo,
        which lies within it."""
        for name, handle in self._regions.items():
            wanted = name != selected and name not in self._meshes
            if wanted and name not in self._clickable:
                handle.on_click(lambda event, name=name: self._on_region(name))
                self._clickable.add(name)
            elif not wanted and name in self._clickable:
                handle.remove_click_callback("all")
                self._clickable.remove(name)

    @property
    def _glass(self) -> float:
        return _FAINT_GLASS if self.objects.has_part else _GLASS

    def apply_visibility(self) -> None:
        """Show what `visible` says; regions are faint where a part is to be seen in them."""
        shown = self.visible
        self._grid.visible = shown["grid"]
        self.objects.apply()
        for handle in self._regions.values():
            handle.visible, handle.opacity = shown["regions"], self._glass
        if self._gizmo is not None:
            self._gizmo.visible = shown["regions"]


def region_colour(number: int) -> tuple[int, int, int]:
    """A colour for the region of that number, sRGB of 0 to 255."""
    return _COLOURS[number % len(_COLOURS)]


def _box_edges() -> np.ndarray:
    """(12, 2, 3) the edges of the cube from -1 to 1."""
    edges = []
    for axis in range(3):
        for a in (-1.0, 1.0):
            for b in (-1.0, 1.0):
                ends = np.full((2, 3), 0.0)
                ends[:, axis] = (-1.0, 1.0)
                ends[:, (axis + 1) % 3], ends[:, (axis + 2) % 3] = a, b
                edges.append(ends)
    return np.array(edges)
