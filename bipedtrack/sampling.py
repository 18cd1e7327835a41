"""Table II as ranges, and what episodes are drawn from at a difficulty.

All that difficulty changes (ranges, shares, hold) is data in a `Distribution`, so one compiled program serves all parts of
a lesson and all kinds of an evaluation.
Random numbers are jax's; the namespace is jax.numpy. It is imported inside the functions, so that ranges can be read, and
a missing jax be named, without it.
"""

from __future__ import annotations

from typing import NamedTuple

from bipedtrack.planner import SHORTEST
from bipedtrack.rotations import Array

KINDS = ("stand", "squat", "walk", "sidle", "turn", "wander", "stairs")
STAND, SQUAT, WALK, SIDLE, TURN, WANDER, STAIRS = range(len(KINDS))


class Ranges(NamedTuple):
    """Table II as ranges: (lowest, mildest, highest) at full difficulty; at difficulty 0 all is mildest.

    An episode draws its motion from them; `step_variation` then goes up to a fifth beyond them from step to step, but for
    the period: what would lie outside is the range's end, which at full difficulty is so for a fifth of the steps.
    """

    period: tuple[float, float, float] = (0.4, 0.55, 0.7)  # s, of a task step with a swing foot
    walk_step: tuple[float, float, float] = (-0.15, 0.0, 0.25)  # m the trunk advances; a foot travels twice that
    sidle_step: tuple[float, float, float] = (-0.12, 0.0, 0.12)  # m to the left per task step
    turn_yaw: tuple[float, float, float] = (-0.35, 0.0, 0.35)  # rad per task step
    turn_radius: tuple[float, float, float] = (0.0, 0.2, 0.6)  # m
    stair_riser: tuple[float, float, float] = (0.02, 0.02, 0.17)  # m
    stair_tread: tuple[float, float, float] = (0.25, 0.30, 0.35)  # m
    lift: tuple[float, float, float] = (0.04, 0.08, 0.15)  # m above the higher end of the swing
    trunk_height: tuple[float, float, float] = (0.70, 0.75, 0.79)  # m above the mean of the soles, while stepping
    stair_trunk_height: tuple[float, float, float] = (0.70, 0.73, 0.75)  # m
    step_variation: tuple[float, float, float] = (0.8, 1.0, 1.2)  # factor on period, lift and advance from step to step
    curve_along: tuple[float, float, float] = (-0.05, 0.0, 0.05)  # shift of the Bezier control points, share of the way
    curve_height: tuple[float, float, float] = (0.8, 1.0, 1.2)  # factor on the heights of the Bezier control points
    trigonometric: tuple[float, float, float] = (
        -1.0,
        -1.0,
        0.3,
    )  # below 0: Bezier, above: trigonometric ankles, from 0.77 on
    swing_ease: tuple[float, float, float] = (0.2, 0.25, 0.3)  # planner.TaskStep.ease; 0: the paper's uniform curves
    sway: tuple[float, float, float] = (0.0, 0.0, 0.0)  # clipped to [0, 1]: factor on statics.pendulum; 0: the paper's trunk
    posture_x: tuple[float, float, float] = (-0.05, 0.0, 0.05)  # m, centre of mass before the feet's middle (stand, squat)
    posture_y: tuple[float, float, float] = (-0.04, 0.0, 0.04)  # m, to the left of it
    posture_height: tuple[float, float, float] = (0.60, 0.75, 0.79)  # m
    posture_roll: tuple[float, float, float] = (-0.15, 0.0, 0.15)  # rad
    posture_pitch: tuple[float, float, float] = (-0.15, 0.0, 0.15)  # rad
    posture_yaw: tuple[float, float, float] = (-0.3, 0.0, 0.3)  # rad
    foot_x: tuple[float, float, float] = (-0.1, 0.0, 0.1)  # m, left foot ahead of the right (stand, squat)
    foot_distance: tuple[float, float, float] = (0.17, 0.20, 0.30)  # m
    foot_yaw: tuple[float, float, float] = (-0.2, 0.0, 0.2)  # rad
    squat_period: tuple[float, float, float] = (0.5, 1.0, 1.5)  # s, of a way of the trunk; the paper prints no such time
    wander_x: tuple[float, float, float] = (-0.10, 0.0, 0.25)  # m, of a foothold from beside the other foot, ahead
    wander_y: tuple[float, float, float] = (-0.02, 0.0, 0.15)  # m, outwards
    wander_yaw: tuple[float, float, float] = (-0.25, 0.0, 0.25)  # rad
    push: tuple[float, float, float] = (0.0, 0.0, 30.0)  # N s, horizontal impulse on the trunk, from 0; in training alone
    stair_push: tuple[float, float, float] = (0.0, 0.0, 30.0)  # N s, on stairs, where there is no room to step aside

    @property
    def usual_sway(self) -> float:
        """The sway of the mildest task steps, in [0, 1]."""
        return float(min(max(self.sway[1], 0.0), 1.0))

    def swaying(self, sway: float) -> Ranges:
        """The same with trunks that all sway so much."""
        return self._replace(sway=(sway, sway, sway))

    def validate(self) -> None:
        """Raises ValueError where a range does not grow."""
        for name, (low, mild, high) in self._asdict().items():
            if not low <= mild <= high:
                raise ValueError(f"{name} must be [lowest, mildest, highest], not {[low, mild, high]}")
        for name in ("push", "stair_push"):
            if getattr(self, name)[0] != 0:
                raise ValueError(f"{name} must begin at 0, not {getattr(self, name)[0]:g}: impulses are drawn from 0 on")
        if min(self.period[0], self.squat_period[0]) < SHORTEST:
            raise ValueError(f"periods must be at least {SHORTEST:g} s")
        if not 0 <= self.swing_ease[0] <= self.swing_ease[2] < 0.5:
            raise ValueError(f"swing_ease must lie in [0, 0.5), not {list(self.swing_ease)}")


class Shares(NamedTuple):
    """How often each kind is drawn, up to a common factor."""

    stand: float
    squat: float
    walk: float
    sidle: float
    turn: float
    stairs: float
    wander: float = 0.0

    def validate(self) -> None:
        """Raises ValueError where no kind can be drawn."""
        if min(self) < 0 or sum(self) <= 0:
            raise ValueError(f"shares must not be negative and not all be zero: {self._asdict()}")


class Distribution(NamedTuple):
    """What episodes are drawn from: arrays, carried along in the state of every environment."""

    shares: Array  # (7,) cumulative in the order of KINDS, ending at 1
    hold_share: Array  # () share of the episodes that stop and hold
    hold_after: Array  # (2,) least and greatest number of task steps before the hold
    down_share: Array  # () share of the stairs that go down
    mix_share: Array  # () share of the episodes on level ground that change their kind every `tasks.MIX_STEPS` task steps
    break_share: Array  # () share of the episodes that stop in stride, or bring the feet together, every few task steps
    push_share: Array  # () share of the episodes with pushes
    ranges: dict[str, Array]  # by the names of Ranges, (2,) each: lowest and highest at this difficulty


def distribution(
    ranges: Ranges,
    shares: Shares,
    difficulty: float,
    hold_share: float,
    hold_after: tuple[int, int],
    down_share: float = 0.5,
    mix_share: float = 0.0,
    push_share: float = 0.0,
    break_share: float = 0.0,
) -> Distribution:
    """The distribution at a difficulty in [0, 1]: ranges shrink linearly from full to their mildest value."""
    import jax.numpy as jnp

    ordered = [getattr(shares, kind) for kind in KINDS]
    total = jnp.array(ordered, jnp.float32)
    last = max(i for i, share in enumerate(ordered) if share > 0)  # rounding must not leave room behind it
    scaled = {
        name: jnp.array([mild + difficulty * (low - mild), mild + difficulty * (high - mild)], jnp.float32)
        for name, (low, mild, high) in ranges._asdict().items()
    }
    return Distribution(
        shares=jnp.cumsum(total / total.sum()).at[last:].set(1.0),
        hold_share=jnp.float32(hold_share),
        hold_after=jnp.array(hold_after, jnp.float32),
        down_share=jnp.float32(down_share),
        mix_share=jnp.float32(mix_share),
        break_share=jnp.float32(break_share),
        push_share=jnp.float32(push_share),
        ranges=scaled,
    )


def sample(key: Array, names: tuple[str, ...], ranges: dict[str, Array]) -> dict[str, Array]:
    """One uniform number per name, within its range."""
    import jax

    u = jax.random.uniform(key, (len(names),))
    return {name: within(u[i], ranges[name]) for i, name in enumerate(names)}


def within(u: Array, bounds: Array) -> Array:
    """The number at the share u of a range (2,)."""
    return bounds[0] + u * (bounds[1] - bounds[0])
