"""How well a policy tracks, for each kind of task step, beside inverse kinematics alone."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import rich.table

from bipedtrack import curriculum, env, policy, robot, rollout, sampling

HOLD = "hold"  # any kind, stopped after some task steps


@dataclasses.dataclass(frozen=True)
class Row:
    """One kind of task step: `episodes` episodes of `seconds` with a deterministic policy in MJX."""

    kind: str
    episodes: int
    survival: float  # share of the episodes without a fall
    seconds: float  # mean until the fall or the time limit
    ankle_error_cm: float  # this and the following: means until the fall, averaged over episodes
    ankle_yaw_error_deg: float
    trunk_error_cm: float
    trunk_error_deg: float


def by_kind(
    config: curriculum.Curriculum, trained: policy.Policy | None, difficulty: float, episodes: int, seed: int
) -> list[Row]:
    """A row for every kind that the curriculum has, and for hold if it has that.

    Args:
      config: the curriculum, for ranges, kinds and episode length.
      trained: the policy, with its control law; None is inverse kinematics alone, with the curriculum's.
      difficulty: of the ranges, in [0, 1].
      episodes: for each row.
      seed: of the episodes; the same seed gives the same episodes to every policy.
    """
    kinds = [k for k in sampling.KINDS if any(getattr(stage.shares, k) > 0 for stage in config.stages)]
    holds = [stage for stage in config.stages if stage.hold_share > 0]
    given = [_only(config, {kind: 1.0}, difficulty, 0.0, (0, 0)) for kind in kinds]
    if holds:
        given.append(_only(config, dict.fromkeys(kinds, 1.0), difficulty, 1.0, holds[-1].hold_after))
    batch = jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), episodes, axis=0), *given)
    law = config.control if trained is None else trained.settings
    settings = env.EnvConfig(config.rewards, law, config.policy_period, stairs="stairs" in kinds)
    the_env = env.TrackingEnv(robot.load(config.robot), settings, given[0])

    def act(observation: Any) -> Any:
        if trained is None:
            return jnp.zeros(the_env.action_size)
        return trained.output(observation)

    result = rollout.outcomes(the_env, act, batch, config.episode_seconds, seed)
    rows = []
    for i, kind in enumerate([*kinds, HOLD] if holds else kinds):
        mine = slice(i * episodes, (i + 1) * episodes)
        means = {name: float(np.mean(values[mine])) for name, values in result.errors.items()}
        survival, seconds = float(result.survived[mine].mean()), float(result.seconds[mine].mean())
        rows.append(Row(kind, episodes, survival, seconds, **means))
    return rows


def _only(
    config: curriculum.Curriculum,
    shares: dict[str, float],
    difficulty: float,
    hold_share: float,
    hold_after: tuple[int, int],
) -> sampling.Distribution:
    chosen = sampling.Shares(**(dict.fromkeys(sampling.KINDS, 0.0) | shares))
    return sampling.distribution(config.ranges, chosen, difficulty, hold_share, hold_after)


def level_ground(rows: list[Row]) -> Row | None:
    """The mean over the kinds on level ground, each counting the same; None where there is none."""
    flat = [row for row in rows if row.kind not in ("stairs", HOLD)]
    if not flat:
        return None
    names = [field.name for field in dataclasses.fields(Row)][2:]
    means = {name: float(np.mean([getattr(row, name) for row in flat])) for name in names}
    return Row("level ground", sum(row.episodes for row in flat), **means)


def comparison(config: curriculum.Curriculum, difficulty: float, rows: dict[str, list[Row]]) -> rich.table.Table:
    """A printable table: a line for each kind and controller."""
    first = next(iter(rows.values()))[0]
    table = rich.table.Table(
        title=f"{first.episodes} episodes of {config.episode_seconds:g} s each, difficulty {difficulty:g}, MJX"
    )
    for name in ("kind", "control", "no fall", "lasts", "ankles", "yaw", "trunk", "tilt"):
        table.add_column(name, justify="left" if name in ("kind", "control") else "right")
    for pair in zip(*rows.values(), strict=True):
        for name, row in zip(rows, pair, strict=True):
            table.add_row(
                row.kind,
                name,
                f"{100 * row.survival:.0f} %",
                f"{row.seconds:.1f} s",
                f"{row.ankle_error_cm:.1f} cm",
                f"{row.ankle_yaw_error_deg:.1f} deg",
                f"{row.trunk_error_cm:.1f} cm",
                f"{row.trunk_error_deg:.1f} deg",
            )
    return table
