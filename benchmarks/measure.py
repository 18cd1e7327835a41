"""What every benchmark needs: devices, timing of jitted functions, limits of the machine, one JSON line a case."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import tyro

from bipedtrack import train
from bipedtrack.messages import Refusal, fail, quiet_imports

with quiet_imports():  # nothing but JSON lines is printed
    from mujoco import mjx  # noqa: F401

Options = TypeVar("Options")


def run(main: Callable[[Options], None], options: type[Options]) -> None:
    """A benchmark's command line: what its options refuse is one line and exit status 2."""
    try:
        main(tyro.cli(options))
    except (Refusal, OSError) as error:
        fail(str(error))


def require_positive(**numbers: int) -> None:
    """Raises Refusal for the first of some options that is not at least 1."""
    for name, number in numbers.items():
        if number < 1:
            raise Refusal(f"--{name} {number}: must be at least 1")


def use_devices(count: int, shares_out: Callable[[int], bool]) -> int:
    """Makes the CPU count as so many devices, 0: as many as there are cores, or the most of them that share the work evenly.

    Returns how many local devices there are. Must come before anything else of JAX. Raises Refusal where the work cannot be
    shared out.

    shares_out: whether a number of devices shares the work evenly.
    """
    if count < 0:
        raise Refusal(f"--devices {count}: must not be negative")
    count = count or next(count for count in range(train.cores(), 0, -1) if shares_out(count))
    jax.config.update("jax_num_cpu_devices", count)
    found = jax.local_device_count()
    if not shares_out(found):
        raise Refusal(f"{found} devices: the robots cannot be shared out evenly; wanted another number of devices or robots")
    return found


def line(**fields: Any) -> dict[str, Any]:
    """Prints a case as one JSON line, floats to four digits, and returns it."""
    device = jax.devices()[0]
    machine = {"device": device.device_kind, "devices": jax.local_device_count(), "cores": os.cpu_count()}
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in fields.items()}
    print(json.dumps(rounded | machine | {"system": platform.machine()}), flush=True)
    return rounded


def shared_out(tree: Any, devices: int) -> Any:
    """A batch of robots (n, ...) as (devices, n / devices, ...)."""
    return jax.tree.map(lambda leaf: leaf.reshape(devices, -1, *leaf.shape[1:]), tree)


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], float]:
    """A function mapped over all devices (the arguments' first axis), compiled, and the seconds that took with tracing."""
    began = time.perf_counter()
    made = jax.pmap(function).lower(*arguments).compile()
    return made, time.perf_counter() - began


def seconds_of(run: Callable[[], Any], repeats: int = 3) -> float:
    """The least of several times of a run, s, after one that warms up; its result is waited for."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - began)
    return min(times)


def matrix_limit(dtype: Any = jnp.float32, size: int = 2048, repeats: int = 8) -> float:
    """Floating point operations per second of products of square matrices on all devices: a network can have no more."""
    devices = jax.local_device_count()
    a = jnp.ones((devices, size, size), dtype)
    product, _ = compiled(lambda a: jnp.matmul(a, a, preferred_element_type=jnp.float32), a)
    return devices * 2 * size**3 / seconds_of(lambda: product(a), repeats)
