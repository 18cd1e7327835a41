"""What was recorded of a robot at 200 Hz: commands and states of the same instants, whatever simulated them."""

from __future__ import annotations

import io
import pathlib
from typing import Any, NamedTuple

import numpy as np

from bipedtrack import checkpoint
from bipedtrack.nodes import Nodes


class Trace(NamedTuple):
    """Arrays with leading axes (..., n): robots if there are several, then control steps of 0.005 s.

    Entry i holds the state at time[i] and the command of that same instant, then what the controller asked for in answer.
    Positions and orientations are in the world frame.
    """

    time: np.ndarray  # (n,) s
    qpos: np.ndarray  # (..., n, 19) trunk position m, quaternion, joint angles rad
    qvel: np.ndarray  # (..., n, 18) trunk velocity m/s, angular velocity in F_B rad/s, joint velocities rad/s
    target: Nodes  # (..., n, 3), (..., n, 4), (..., n, 2, 3), (..., n, 2): real-time targets I^t
    measured: Nodes  # the same of the robot
    timer: np.ndarray  # (..., n, 2) T of eq (3), s: positive while the foot is planned to be in the air
    still: np.ndarray  # (..., n) bool: the command stands still (all rates zero)
    feedback: np.ndarray  # (..., n, 12) a_fb in [-1, 1]
    joint_targets: np.ndarray  # (..., n, 12) rad
    torques: np.ndarray  # (..., n, 12) N m, as applied, over the step that follows
    foot_forces: np.ndarray  # (..., n, 2) N, normal force of ground and boxes on the soles
    alive: np.ndarray  # (..., n) bool: not yet fallen; entries after a fall mean nothing

    @property
    def timestep(self) -> float:
        """The control period, s."""
        return float(self.time[1] - self.time[0])

    def episode(self, index: int | np.ndarray) -> Trace:
        """The trace of one of several robots, or of several at indices (k,)."""
        return Trace(self.time, *(_pick(part, index) for part in self[1:]))

    def until(self, count: int) -> Trace:
        """The first entries of the trace of one robot."""
        return Trace(*(_pick(part, slice(count)) for part in self))


def _pick(part: Any, index: int | slice | np.ndarray) -> Any:
    return Nodes(*(array[index] for array in part)) if isinstance(part, Nodes) else part[index]


def save(trace: Trace, path: str | pathlib.Path) -> None:
    """Writes a trace as .npz, one array a field (`target_trunk_position` and so on), for anyone to check.

    Raises checkpoint.RunError when it cannot be written.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, part in trace._asdict().items():
        if isinstance(part, Nodes):
            arrays |= {f"{name}_{node}": array for node, array in part._asdict().items()}
        else:
            arrays[name] = part
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    checkpoint.write_bytes(path, content.getvalue())
