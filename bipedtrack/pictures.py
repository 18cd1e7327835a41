"""Pictures of a recorded robot, with green traces of its targets, yellow ones of itself and prints where feet shall go."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from bipedtrack import robot, swings
from bipedtrack.nodes import Nodes
from bipedtrack.trace import Trace

TARGET_COLOR = (0.00, 0.80, 0.00, 1.0)  # pure hues, which stay what they are in any light
MEASURED_COLOR = (1.00, 0.90, 0.00, 1.0)
PRINT_COLORS = ((0.16, 0.45, 0.85, 1.0), (0.95, 0.45, 0.10, 1.0))  # left, right
COLORS = (TARGET_COLOR, MEASURED_COLOR, *PRINT_COLORS)
TARGET_WIDTH, MEASURED_WIDTH = 1 / 90, 1 / 160  # of the picture's height; where both agree, green frames yellow
PRINT_THICKNESS = 0.003  # m
TAIL = 2.0  # s, how long a trace lasts behind the robot and a print after its touchdown
AHEAD = 1.0  # s, how long before its swing begins a foothold is shown
_TRACE_POINTS = 30  # per second
_SMOOTHING = 1.0  # s of the trunk's path over which the camera averages

# Measured at 640 x 480 with EGL in software: a picture takes 75 ms of one core, of which antialiasing 40 and shadows 25.
# The MJCF's own settings (reflecting floor, larger shadow map) took 260 ms, and capsules instead of lines 250 ms more.
_SAMPLES, _SHADOW_MAP = 4, 1024


class Foothold(NamedTuple):
    """Where a foot is planned to touch down."""

    foot: int  # 0 left, 1 right
    begin: float  # s, when its swing begins
    touchdown: float  # s
    position: np.ndarray  # (3,) m, the point on the ground under the ankle, in the world frame
    yaw: float  # rad


def footholds(recorded: Trace, ankle_height: float) -> list[Foothold]:
    """Where and when the target put each swinging foot down, (n, ...) arrays of one robot, in the order of time.

    A swing that is not over when the trace ends has no foothold.
    """
    found = []
    starts, ends = swings.starts_and_ends(recorded.timer[None])
    for foot in range(2):
        for begin, end in zip(*map(np.flatnonzero, (starts[0, :, foot], ends[0, :, foot])), strict=False):
            position = np.array(recorded.target.ankle_positions[end, foot], float) - [0, 0, ankle_height]
            yaw = float(recorded.target.ankle_yaws[end, foot])
            found.append(Foothold(foot, float(recorded.time[begin]), float(recorded.time[end]), position, yaw))
    return sorted(found, key=lambda foothold: foothold.begin)


def render(
    model: Any,
    the_robot: robot.Robot,
    recorded: Trace,
    ticks: np.ndarray,
    boxes: np.ndarray | None = None,
    size: tuple[int, int] = (640, 480),
) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) uint8 of one recorded robot, one for each tick. Needs MUJOCO_GL where no screen is.

    Args:
      model: MuJoCo's, from `robot.build_model`; it is not changed.
      the_robot: its constants, for the size of a sole.
      recorded: the trace, arrays (n, ...).
      ticks: indices into the trace.
      boxes: where the model's mocap bodies are, position m and quaternion: (n, boxes, 7), or (boxes, 7) if they stay.
      size: width and height in pixels.

    Raises:
      ValueError: boxes or the trace have another shape.
    """
    import mujoco

    if recorded.qpos.shape != (len(recorded.time), model.nq):
        raise ValueError(f"qpos of the trace has shape {recorded.qpos.shape}; wanted {(len(recorded.time), model.nq)}")
    boxes = _box_poses(boxes, len(recorded.time), model.nmocap)
    planned = footholds(recorded, the_robot.ankle_height)
    middle = _smoothed(np.asarray(recorded.qpos[:, :3], float), round(_SMOOTHING / recorded.timestep))

    model = _fast_to_render(model, size)
    data = mujoco.MjData(model)
    camera, options = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.distance, camera.azimuth, camera.elevation = 2.5, 128, -16
    options.geomgroup[3] = 0  # shapes that only collide
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for tick in map(int, ticks):
            _place(model, data, recorded.qpos[tick], boxes[tick])
            data.light_xpos[:, :2] += middle[tick, :2]  # the shadow map covers the surroundings of the light alone
            camera.lookat[:] = middle[tick] - [0, 0, 0.22]
            renderer.update_scene(data, camera, options)
            _add_traces(renderer.scene, recorded, tick, size[1])
            for foothold in planned:
                shown = foothold.begin - AHEAD <= recorded.time[tick] <= foothold.touchdown + TAIL
                if shown and _has_ground(model, data, foothold.position):
                    _add_print(renderer.scene, foothold, the_robot.sole)
            yield renderer.render()


def _box_poses(boxes: np.ndarray | None, count: int, wanted: int) -> np.ndarray:
    """Poses (n, boxes, 7)."""
    given = np.zeros((0, 7)) if boxes is None else np.asarray(boxes, float)
    if given.shape not in ((wanted, 7), (count, wanted, 7)):
        raise ValueError(f"boxes have shape {given.shape}; wanted {(wanted, 7)} or {(count, wanted, 7)}")
    return np.broadcast_to(given, (count, wanted, 7))


def _fast_to_render(model: Any, size: tuple[int, int]) -> Any:
    """A copy of the model with room for the picture and the quality that the time allows."""
    model = copy.deepcopy(model)
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.vis.quality.offsamples, model.vis.quality.shadowsize = _SAMPLES, _SHADOW_MAP
    return model


def _place(model: Any, data: Any, qpos: np.ndarray, boxes: np.ndarray) -> None:
    """Computes where everything is that is drawn, with the robot at qpos (19,) and the boxes at (boxes, 7)."""
    import mujoco

    data.qpos[:] = qpos
    data.mocap_pos[:], data.mocap_quat[:] = boxes[:, :3], boxes[:, 3:]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def _smoothed(path: np.ndarray, width: int) -> np.ndarray:
    """The moving average of a path (n, 3) over `width` entries, its ends held."""
    before = width // 2
    padded = np.concatenate([np.repeat(path[:1], before, axis=0), path, np.repeat(path[-1:], width - before, axis=0)])
    total = np.cumsum(np.concatenate([np.zeros((1, 3)), padded]), axis=0)
    return (total[width:] - total[:-width])[: len(path)] / width


def _tail(nodes: Nodes, tick: int, timestep: float) -> np.ndarray:
    """The last places of trunk, left and right ankle, (3, points, 3) m, up to the given tick."""
    every = max(1, round(1 / (_TRACE_POINTS * timestep)))
    first = max(0, tick - round(TAIL / timestep))
    # always the same ticks, so that a trace lies still while its end moves on
    picked = [*range(-(-first // every) * every, tick, every), tick]
    ankles = np.asarray(nodes.ankle_positions, float)[picked]
    return np.stack([np.asarray(nodes.trunk_position, float)[picked], ankles[:, 0], ankles[:, 1]])


def _add_traces(scene: Any, recorded: Trace, tick: int, height: int) -> None:
    """Adds the tails of targets and of measured nodes to the scene, as lines for a picture of that height in pixels."""
    import mujoco

    line = mujoco.mjtGeom.mjGEOM_LINE
    sides = (recorded.target, TARGET_COLOR, TARGET_WIDTH), (recorded.measured, MEASURED_COLOR, MEASURED_WIDTH)
    for nodes, color, width in sides:
        for path in _tail(nodes, tick, recorded.timestep):
            for start, end in itertools.pairwise(path):
                mujoco.mjv_connector(_add_geom(scene, line, color), line, width * height, start, end)


def _add_print(scene: Any, foothold: Foothold, sole: np.ndarray) -> None:
    """Adds a foothold to the scene as a flat box of the size of a sole, (2,) m."""
    import mujoco

    cosine, sine = np.cos(foothold.yaw), np.sin(foothold.yaw)
    geom = _add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, PRINT_COLORS[foothold.foot])
    geom.size[:] = [sole[0] / 2, sole[1] / 2, PRINT_THICKNESS / 2]
    geom.pos[:] = foothold.position
    geom.mat[:] = [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]


def _add_geom(scene: Any, shape: Any, color: tuple[float, ...]) -> Any:
    """A new decoration of the scene, still without size and place."""
    import mujoco

    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, shape, np.zeros(3), np.zeros(3), np.eye(3).reshape(9), np.array(color, np.float32))
    scene.ngeom += 1
    return geom


def _has_ground(model: Any, data: Any, point: np.ndarray) -> bool:
    """Whether the floor or the top of a box lies at the point (3,): treads far from the robot may be missing."""
    if abs(point[2]) < 0.01:
        return True
    for geom in np.flatnonzero(model.body_mocapid[model.geom_bodyid] >= 0):
        local = (point - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        if (np.abs(local) < model.geom_size[geom] + 0.01).all() and local[2] > model.geom_size[geom][2] - 0.01:
            return True
    return False
