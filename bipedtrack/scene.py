"""What is seen of a drive, as nodes of a viser scene: the robot of the MJCF, boxes, targets, traces, prints and handles."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser

from bipedtrack import footsteps, robot, rotations, steering
from bipedtrack.drive import View
from bipedtrack.footholds import Foothold
from bipedtrack.footsteps import Box
from bipedtrack.nodes import Nodes
from bipedtrack.steering import Steering

TARGET_COLOR = (0, 204, 0)
MEASURED_COLOR = (255, 217, 0)
PRINT_COLORS = ((41, 115, 217), (242, 115, 26))  # left, right
OUT_OF_REACH_COLOR = (220, 30, 30)
_PRINTS = 13
_TAIL = 60  # views that a trace keeps, 2 s
_PLATE = 0.006  # m, thickness of a print
_VISIBLE_GROUPS = 3  # geoms of higher groups only collide


class Scene:
    """The scene of one drive, shared by all viewers."""

    def __init__(self, server: viser.ViserServer, the_robot: robot.Robot):
        """Draws the robot at the origin; `show` puts everything in its place."""
        self._scene = server.scene
        self._robot = the_robot
        self._model = robot.build_model(the_robot.name)
        self._data = mujoco.MjData(self._model)
        self._scene.set_up_direction("+z")
        self._scene.configure_environment_map(None)
        self._scene.add_light_ambient("/ambient", intensity=1.2)
        self._world = self._scene.add_frame("/world", show_axes=False)
        self._scene.add_grid(
            "/world/floor", infinite_grid=True, cell_size=0.25, section_size=1.0, fade_distance=25.0, plane_opacity=1.0,
            plane_color=(235, 236, 238), position=(0.0, 0.0, -0.001),
        )  # fmt: skip
        self._bodies = self._draw_robot()
        self._boxes: tuple[Box, ...] = ()
        self._box_nodes: list[Any] = []
        self._targets = [
            self._scene.add_icosphere(f"/world/target/{i}", radius=0.02, color=TARGET_COLOR, cast_shadow=False)
            for i in range(3)
        ]
        self._traces = {color: deque[np.ndarray](maxlen=_TAIL) for color in (TARGET_COLOR, MEASURED_COLOR)}
        self._lines = {
            color: self._scene.add_line_segments(
                f"/world/trace/{i}", np.zeros((0, 2, 3), np.float32), color, thickness=0.012
            )
            for i, color in enumerate(self._traces)
        }
        self._prints = [
            self._scene.add_box(f"/world/print/{i}", dimensions=self._plate, visible=False, cast_shadow=False)
            for i in range(_PRINTS)
        ]
        self._shown_prints: tuple[Foothold, ...] = ()
        self.foot = self._scene.add_transform_controls(
            "/world/next_foot", scale=0.22, active_axes=(True, True, False), depth_test=False, opacity=0.8
        )
        self._foot_plate = self._scene.add_box(
            "/world/next_foot/plate", dimensions=self._plate, opacity=0.6, cast_shadow=False
        )
        self.trunk = self._scene.add_transform_controls("/world/next_trunk", scale=0.22, depth_test=False, opacity=0.6)
        self._trunk_box = self._scene.add_box(
            "/world/next_trunk/box", dimensions=(0.3, 0.3, 0.15), color=TARGET_COLOR, opacity=0.25, cast_shadow=False
        )
        self._trunk_asked: tuple[Nodes, Steering] | None = None  # to which `_trunk_end` belongs
        # the viewer in whose hand a handle is, "foot" or "trunk": it stays where it is held
        self.held: dict[str, int | None] = {}

    @property
    def _plate(self) -> tuple[float, float, float]:
        length, width = map(float, self._robot.sole)
        return length, width, _PLATE

    def _draw_robot(self) -> dict[int, viser.FrameHandle]:
        """One frame a body, its visible geoms below it."""
        frames = {}
        for body in range(1, self._model.nbody):
            frames[body] = self._scene.add_frame(f"/world/robot/{self._model.body(body).name}", show_axes=False)
            for geom in np.flatnonzero(self._model.geom_bodyid == body):
                if self._model.geom_group[geom] < _VISIBLE_GROUPS:
                    shape = shape_of(self._model, int(geom))
                    self._scene.add_mesh_simple(
                        f"{frames[body].name}/geom_{geom}",
                        np.asarray(shape.vertices, np.float32),
                        np.asarray(shape.faces, np.uint32),
                        color=color_of(self._model, int(geom)),
                        position=self._model.geom_pos[geom],
                        wxyz=self._model.geom_quat[geom],
                    )
        return frames

    def show(self, view: View, follow: bool) -> None:
        """Puts everything where the view has it; with follow, the robot stays in the middle and the world moves."""
        self._data.qpos[:] = np.nan_to_num(view.qpos)
        mujoco.mj_kinematics(self._model, self._data)
        for body, frame in self._bodies.items():
            frame.position, frame.wxyz = self._data.xpos[body].copy(), self._data.xquat[body].copy()
        if view.boxes != self._boxes:
            self._draw_boxes(view.boxes)
        middle = self._data.qpos[:3] * [1, 1, 0] if follow else np.zeros(3)
        self._world.position = -middle
        places = [_places(nodes) for nodes in (view.target, view.measured)]
        for node, position in zip(self._targets, places[0], strict=True):
            node.position = position
        for trace, place in zip(self._traces.values(), places, strict=True):
            trace.append(place)
        if view.prints != self._shown_prints:
            self._draw_prints(view.prints)
        if "foot" not in self.held:
            self._hold_at(self.foot, *self._on_ground(view.next_foot))
            self._foot_plate.color = PRINT_COLORS[view.next_foot.foot]
        if "trunk" not in self.held:
            self._hold_at(self.trunk, *self._next_trunk(view))
            self._trunk_box.color = TARGET_COLOR

    def _next_trunk(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Position and quaternion of the trunk as it is asked to be over the feet."""
        asked = view.step.end, view.steering
        if self._trunk_asked is None or self._trunk_asked[0] is not asked[0] or self._trunk_asked[1] != asked[1]:
            self._trunk_asked = asked
            self._trunk_end = steering.trunk_step(self._robot, *asked).end
        return self._trunk_end.trunk_position, self._trunk_end.trunk_orientation

    def show_traces(self) -> None:
        """Draws the traces up to the last view; it costs more than the rest, so do it less often."""
        for color, trace in self._traces.items():
            path = np.array(trace, np.float32)
            segments = np.stack([path[:-1], path[1:]], axis=2).reshape(-1, 2, 3)
            # after a reset the robot is elsewhere at once
            self._lines[color].points = segments[np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1) < 0.3]

    def mark(self, handle: str, within_reach: bool) -> None:
        """Colours a handle's ghost, "foot" or "trunk": red where the robot cannot follow."""
        node, color = (self._foot_plate, MEASURED_COLOR) if handle == "foot" else (self._trunk_box, TARGET_COLOR)
        node.color = color if within_reach else OUT_OF_REACH_COLOR

    def foothold(self, foot: int) -> Foothold:
        """Where the handle of the next foothold is."""
        x, y, _ = self.foot.position
        w, _, _, z = self.foot.wxyz
        return Foothold(foot, float(x), float(y), 2 * math.atan2(float(z), float(w)))

    def _on_ground(self, at: Foothold) -> tuple[np.ndarray, np.ndarray]:
        """Position and quaternion of a print."""
        z = footsteps.ground(self._boxes, at.x, at.y) + _PLATE / 2
        return np.array([at.x, at.y, z]), np.array(rotations.from_yaw(np.float64(at.yaw)))

    def _hold_at(self, handle: viser.TransformControlsHandle, position: np.ndarray, wxyz: np.ndarray) -> None:
        if max(np.abs(handle.position - position).max(), np.abs(handle.wxyz - wxyz).max()) > 1e-4:
            handle.position, handle.wxyz = position, wxyz

    def _draw_boxes(self, boxes: tuple[Box, ...]) -> None:
        for node in self._box_nodes:
            node.remove()
        self._boxes = boxes
        self._box_nodes = [
            self._scene.add_box(
                f"/world/box/{i}", dimensions=box.size, color=(158, 153, 143), position=box.position, wxyz=box.orientation
            )
            for i, box in enumerate(boxes)
        ]

    def _draw_prints(self, prints: tuple[Foothold, ...]) -> None:
        self._shown_prints = prints
        for i, node in enumerate(self._prints):
            node.visible = i < len(prints)
            if node.visible:
                node.color = PRINT_COLORS[prints[i].foot]
                node.position, node.wxyz = self._on_ground(prints[i])


def _places(nodes: Nodes) -> np.ndarray:
    """Trunk, left and right ankle, (3, 3) m."""
    return np.concatenate([np.nan_to_num(nodes.trunk_position)[None], np.nan_to_num(nodes.ankle_positions)])


def shape_of(model: Any, geom: int) -> trimesh.Trimesh:
    """The surface of a primitive geom in its own frame, m. Raises ValueError for other geoms."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        capsule = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=(16, 16))
        capsule.apply_translation(-capsule.bounds.mean(axis=0))
        return capsule
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        ball = trimesh.creation.icosphere(subdivisions=2)
        ball.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else [size[0]] * 3)
        return ball
    raise ValueError(f"geom {geom} is a {kind.name}; wanted a box, cylinder, capsule, sphere or ellipsoid")


def color_of(model: Any, geom: int) -> tuple[int, int, int]:
    """Red, green and blue of a geom's material, or else its own, 0 to 255."""
    material = model.geom_matid[geom]
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    red, green, blue = (round(255 * float(share)) for share in rgba[:3])
    return red, green, blue
