"""What many tests share: the robot, its compiled model, the default curriculum. JAX runs on the CPU."""

import concurrent.futures
import functools
import multiprocessing
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before anything imports jax

import hypothesis
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import reports
from filmed import Rendered

from bipedtrack import planner, sampling, tasks, video
from bipedtrack import robot as robots
from bipedtrack.curriculum import Curriculum
from bipedtrack.curriculum import load as load_curriculum

# compiling and a busy machine make single examples slow; that is no failure
hypothesis.settings.register_profile("bipedtrack", deadline=None)
hypothesis.settings.load_profile("bipedtrack")


@pytest.fixture(scope="session")
def robot() -> robots.Robot:
    """The constants of the robot of Table I, float64."""
    return robots.load()


@pytest.fixture(scope="session")
def mj_model() -> mujoco.MjModel:
    """Its compiled model, without boxes. Tests that change a model build their own."""
    return robots.build_model("ranger_max")


@pytest.fixture(scope="session")
def curriculum() -> Curriculum:
    """The default curriculum."""
    return load_curriculum("quick")


class Episodes(NamedTuple):
    """Many episodes of one kind as numpy arrays, with the leading axes (episode, task step, instant)."""

    task: tasks.Task  # (episodes, ...)
    step: planner.TaskStep  # (episodes, steps, ...)
    time: np.ndarray  # (episodes, steps, instants) s into the step, from 0 to its period
    command: planner.Command  # (episodes, steps, instants, ...)


@pytest.fixture(scope="session")
def episodes(robot: robots.Robot, curriculum: Curriculum) -> Callable[..., Episodes]:
    """Draws 300 episodes of 12 task steps: episodes(kind, difficulty=1.0, hold_after=None)."""
    count, steps, instants = 300, 12, 21

    def one(key: Any, given: sampling.Distribution) -> tuple:
        key_begin, key_steps = jax.random.split(key)
        task, start = tasks.begin(key_begin, given, robot)

        def following(start: Any, indexed_key: Any) -> tuple:
            index, key = indexed_key
            step = tasks.next_step(key, given, task, index, start, robot)
            times = jnp.linspace(0, 1, instants) * step.period
            return step.end, (step, times, jax.vmap(planner.command, (None, 0))(step, times))

        return task, *jax.lax.scan(following, start, (jnp.arange(steps), jax.random.split(key_steps, steps)))[1]

    batched = jax.jit(jax.vmap(one, (0, None)))

    @functools.cache
    def draw(
        kind: str,
        difficulty: float = 1.0,
        hold_after: tuple[int, int] | None = None,
        break_share: float = 0.0,
        sway: float = 0.0,
    ) -> Episodes:
        shares = sampling.Shares(**{name: float(name == kind) for name in sampling.KINDS})
        hold_share = 0.0 if hold_after is None else 1.0
        ranges = curriculum.ranges._replace(sway=(sway, sway, sway))
        given = sampling.distribution(ranges, shares, difficulty, hold_share, hold_after or (1, 8), break_share=break_share)
        keys = jax.random.split(jax.random.PRNGKey(sampling.KINDS.index(kind)), count)
        return Episodes(*jax.tree.map(np.asarray, batched(keys, given)))

    return draw


@pytest.fixture(scope="module")
def unoptimised() -> Iterator[None]:
    """Compiles in half the time what runs only once."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="session")
def whole(robot: robots.Robot) -> dict[str, Any]:
    """A record of an evaluation, made by hand: two policies on three engines, with robustness."""
    return reports.make(robot)


@pytest.fixture
def record(whole: dict[str, Any]) -> dict[str, Any]:
    """The same for a test to change."""
    return reports.copied(whole)


@pytest.fixture(scope="session")
def rendered() -> Iterator[Rendered]:
    """Calls a function of a test's module where mujoco renders; skips where no back end does.

    A process renders with one back end for all its life, so pictures come from a process of their own.
    """
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as process:
        try:
            assert process.submit(video.choose_backend).result() in ("egl", "osmesa", "glfw", os.environ.get("MUJOCO_GL"))
        except video.VideoError as error:
            pytest.skip(str(error))
        yield lambda function, *arguments: process.submit(function, *arguments).result()
