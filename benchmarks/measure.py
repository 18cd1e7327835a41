"""What every benchmark needs: timing of jitted functions, limits of the machine, one JSON line a case."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def line(**fields: Any) -> dict[str, Any]:
    """Prints a case as one JSON line, floats to four digits, and returns it."""
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in fields.items()}
    print(json.dumps(rounded), flush=True)
    return rounded


def machine() -> dict[str, Any]:
    """The device, its name and how many cores there are."""
    device = jax.devices()[0]
    return {"device": device.platform, "kind": device.device_kind, "cores": os.cpu_count(), "system": platform.machine()}


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], float]:
    """A function compiled for its arguments, and the seconds that took (tracing included, no persistent cache)."""
    began = time.perf_counter()
    made = jax.jit(function).lower(*arguments).compile()
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
    """Floating point operations per second of a product of two square matrices, the most that a network can reach."""
    a = jnp.ones((size, size), dtype)
    product, _ = compiled(lambda a, b: jnp.matmul(a, b, preferred_element_type=jnp.float32), a, a)
    return 2 * size**3 / seconds_of(lambda: product(a, a), repeats)
