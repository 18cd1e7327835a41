"""Several processes, on one machine or on many, that train one policy together through `jax.distributed`.

Each has a share of the robots; brax averages their gradients, so that all hold the same parameters. The first process alone
reads and writes the run directory and shows the progress; the others learn from it what to do.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import numpy as np

from bipedtrack.messages import Refusal

_PATIENCE = 60  # s that a process waits for the others at the start
_HEARTBEAT = 30  # s after which a machine that says nothing counts as lost


class DistributedError(Refusal, RuntimeError):
    """Processes that cannot train together; the message is one line."""


@dataclasses.dataclass(frozen=True)
class Process:
    """Which of how many processes this one is."""

    index: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it is the one that reads and writes."""
        return self.index == 0

    def __str__(self) -> str:
        return f"process {self.index} of {self.count}"


ALONE = Process()


def join(coordinator: str, processes: int, process: int, detect: bool) -> Process:
    """Meets the other processes; before JAX does anything else.

    Args:
      coordinator: HOST:PORT where the first process listens; empty for a process alone, or for what `detect` finds.
      processes: how many there are.
      process: the index of this one.
      detect: SLURM, Kubernetes or Open MPI say all that, in the environment.

    Raises DistributedError where the arguments do not fit or the others do not come.
    """
    if not coordinator and (processes != 1 or process != 0):
        raise DistributedError("--processes and --process need --coordinator HOST:PORT, where the first process listens")
    if not coordinator and not detect:
        return ALONE
    if coordinator and detect:
        raise DistributedError("--distributed finds the coordinator in the environment; give it or --coordinator, not both")
    given: dict[str, Any] = {}
    if coordinator:
        _check(coordinator, processes, process)
        # it listens at this address alone, not at all of the machine's
        given = {"coordinator_address": coordinator, "num_processes": processes, "process_id": process}
        given |= {"coordinator_bind_address": coordinator, "cluster_detection_method": "deactivate"}
    import jax

    # it watches for machines that a cluster is about to take back, and warns on stderr when the coordinator has left
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            **given,
            initialization_timeout=_PATIENCE,
            heartbeat_timeout_seconds=_HEARTBEAT,
            shutdown_timeout_seconds=_PATIENCE,
        )
    except ValueError:  # of what is missing
        raise DistributedError(
            "--distributed: SLURM, Kubernetes and Open MPI have left nothing in the environment; wanted a job of theirs, or "
            "--coordinator HOST:PORT --processes N --process I"
        ) from None
    except RuntimeError as error:
        where = coordinator or "the coordinator that the environment names"
        raise DistributedError(f"{where}: the processes did not meet within {_PATIENCE} s ({_line(error)})") from None
    # jax.process_index() would begin to use devices, which are not chosen yet
    from jax._src.distributed import global_state

    return Process(global_state.process_id, global_state.num_processes)


def _check(coordinator: str, processes: int, process: int) -> None:
    """Raises DistributedError where the arguments cannot be."""
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise DistributedError(f"--coordinator {coordinator}: wanted HOST:PORT, as 127.0.0.1:1234")
    if processes < 2:
        raise DistributedError(f"--processes {processes}: wanted the number of processes that train together, at least 2")
    if not 0 <= process < processes:
        raise DistributedError(f"--process {process}: wanted 0 to {processes - 1}, another one for each process")


def from_first(name: str, give: Callable[[], Any], process: Process) -> Any:
    """What `give` returns in the first process, in all of them: anything that JSON can say. The others do not call it.

    It goes through the coordinator, for devices need not have been chosen yet. Each name serves once. Where `give` raises,
    so does this, in the other processes a DistributedError, as where somebody is not there any more.
    """
    if process.count == 1:
        return give()
    from jax._src.distributed import global_state  # JAX has no public name for it (0.9.2)
    from jax.errors import JaxRuntimeError

    client, key = global_state.client, f"bipedtrack/{name}"
    assert client is not None

    def hand_over(text: str) -> str:
        try:
            if process.first:
                client.key_value_set(key, text)
            text = client.blocking_key_value_get(key, 1000 * _PATIENCE)
            client.wait_at_barrier(key, 1000 * _PATIENCE)  # after this the coordinator may end with the first process
        except JaxRuntimeError as error:
            raise DistributedError(f"{process}: the others are not there any more ({_line(error)})") from None
        return text

    try:
        given = give() if process.first else None
    except Exception:
        hand_over("")
        part(process)
        raise
    text = hand_over(json.dumps(given))
    if not text:
        part(process)
        raise DistributedError(f"{process}: the first process refused")
    return json.loads(text)


def require_same(name: str, number: int, process: Process) -> None:
    """Raises DistributedError where a number is not the first process's, as all must have it. Each name serves once."""
    first = from_first(name, lambda: number, process)
    if number != first:
        raise DistributedError(
            f"{process}: has {number} {name}, the first one {first}; wanted --{name} {min(number, first)}"
        )


def share_arrays(arrays: Any, process: Process) -> Any:
    """The tree of arrays that the first process gives; the others give one of the same shapes."""
    if process.count == 1:
        return arrays
    from jax.experimental import multihost_utils

    return multihost_utils.broadcast_one_to_all(arrays)


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """The sha256 of arrays, their names and bytes in the order of names."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        found.update(name.encode() + b"\0" + np.ascontiguousarray(arrays[name]).tobytes())
    return found.hexdigest()


def require_agreement(arrays: Mapping[str, np.ndarray], process: Process) -> None:
    """Raises DistributedError where the processes do not hold the same arrays to the last bit."""
    from jax.experimental import multihost_utils

    mine = np.frombuffer(bytes.fromhex(digest(arrays)), np.uint8)
    everybodys = np.asarray(multihost_utils.process_allgather(mine)).reshape(process.count, -1)
    if (everybodys != mine).any():
        raise DistributedError(f"the parameters of the {process.count} processes have drifted apart")


def part(process: Process) -> None:
    """Says goodbye to the other processes, who do the same now: from here on none needs them."""
    if process.count > 1:
        import jax

        jax.distributed.shutdown()


def leave(status: int) -> NoReturn:
    """Ends this process at once; the usual way would wait for the others, who wait for this one."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
