"""Chunks decoded by the workers of a Dask cluster: an existing one, or processes of this computer."""

import asyncio
import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, Final

from resonator_daemon.base.errors import ExitCode, MissingLibraryError, UsageError, UserError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.extensions.fleet.chunk_decoding import decode_chunk
from resonator_daemon.extensions.fleet.chunks import Chunk, Job

try:
    import dask
    from dask.distributed import Client, KilledWorker, LocalCluster, as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm import CommClosedError, get_address_host_port
    from distributed.scheduler import NoWorkerError
except ImportError as error:
    raise MissingLibraryError(
        f"--workers above 1 and --scheduler need dask.distributed: {how_to_install('distributed')}"
    ) from error

logging.getLogger("distributed").propagate = False  # the command itself reports errors that end it

CONNECT_S: Final = 10.0
_ANY_PORT: Final = "127.0.0.1:0"
DEATHS_MAX: Final = 20  # workers that may die with one chunk, before it counts as the cause
_STARTS_MAX: Final = 5  # attempts, if a worker dies while it starts
_SETTINGS: Final = {
    "distributed.scheduler.allowed-failures": DEATHS_MAX,
    "distributed.scheduler.worker-saturation": 1.0,  # a worker receives its next chunk when it has none
    "distributed.scheduler.no-workers-timeout": "5 minutes",
    "distributed.deploy.lost-worker-timeout": "1 day",  # wait until a killed one has restarted
    "distributed.worker.profile.enabled": False,
    # Omits Dask's limit for malloc, with which each freed array returns its memory to the system.
    "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
}
_LOST: Final = (FutureCancelledError, CommClosedError, asyncio.CancelledError, TimeoutError)


class SchedulerError(UserError):
    """No scheduler answers at the address, or it has ended."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_scheduler"


class WorkersDiedError(UserError):
    """Workers died repeatedly, with one chunk or while they started."""

    exit_code = ExitCode.FAILED
    code = "workers_died"


def decode_on_cluster(
    chunks: Sequence[Chunk], job: Job, scheduler: str | None, workers: int
) -> Iterator[dict[str, Any]]:
    """Yield the report of each chunk once it is done, in any order.

    Parameters
    ----------
    scheduler
        Address of a scheduler; None: processes of this computer.
    workers
        Number of these processes.

    Raises
    ------
    SchedulerError, WorkersDiedError
        The cluster cannot be used, or is lost.
    UsageError
        The address is invalid.
    UserError
        What `decode_chunk` raises.
    """
    if scheduler is not None:
        _check_address(scheduler)
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        cluster = stack.enter_context(_local_cluster(workers)) if scheduler is None else scheduler
        client = stack.enter_context(_client(cluster, scheduler))
        # Longest first: a long chunk at the end would leave the other workers idle.
        chunks = sorted(chunks, key=lambda chunk: -chunk.length_bytes)
        futures = client.map(decode_chunk, chunks, job=job, key=[f"decode-{chunk.key}" for chunk in chunks], pure=False)
        stack.callback(client.cancel, futures)
        for future in as_completed(futures, loop=client.loop):
            try:
                yield future.result()
            except (KilledWorker, NoWorkerError) as error:
                raise WorkersDiedError(
                    f"{future.key}: more than {DEATHS_MAX} workers died with this chunk, or none was left for "
                    "5 minutes; give workers more memory, then repeat the command: it continues with the other chunks"
                ) from error
            except _LOST as error:
                raise _lost(scheduler) from error


def _local_cluster(workers: int) -> Any:
    """Start a cluster of processes of this computer; again if a worker is killed while it starts."""
    for _ in range(_STARTS_MAX):
        try:
            return LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=_ANY_PORT, silence_logs=logging.CRITICAL
            )
        except RuntimeError as error:
            last = error
    raise WorkersDiedError(
        f"workers died {_STARTS_MAX} times while they started; use fewer --workers, or give them more memory"
    ) from last


def _check_address(scheduler: str) -> None:
    """Raise UsageError if an address is invalid; a `Client` would also wait for half a minute and print a traceback."""
    try:
        host, port = get_address_host_port(scheduler)
        if not host or not 0 < port < 1 << 16:
            raise ValueError(f"got host {host!r} and port {port}")
    except ValueError as error:
        raise UsageError(f"--scheduler: {scheduler!r} is no address ({error}); use one as tcp://host:8786") from error


def _client(cluster: Any, scheduler: str | None) -> Any:
    try:
        return Client(cluster, timeout=CONNECT_S, set_as_default=False)
    except (OSError, *_LOST) as error:
        raise SchedulerError(
            f"no scheduler answers at {scheduler} within {CONNECT_S:g} s; start one (dask scheduler), or leave "
            "--scheduler out"
        ) from error


def _lost(scheduler: str | None) -> SchedulerError:
    return SchedulerError(
        f"the scheduler{'' if scheduler is None else f' at {scheduler}'} has ended; repeat the command: it "
        "continues with the chunks that are not done"
    )
