"""Chunks decoded by the workers of a Dask cluster: that of a scheduler, or one of this computer's processes."""

import asyncio
import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, Final

from resonator_daemon.errors import ExitCode, MissingLibraryError, UsageError, UserError
from resonator_daemon.host.printable import how_to_install
from resonator_daemon.redecoding.chunks import Chunk, Job
from resonator_daemon.redecoding.worker import decode_chunk

try:
    import dask
    from dask.distributed import Client, KilledWorker, LocalCluster, as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm import CommClosedError
except ImportError as error:
    raise MissingLibraryError(
        f"several workers, and --scheduler, need dask.distributed: {how_to_install('distributed')}"
    ) from error

logging.getLogger("distributed").propagate = False  # what ends the command is reported by the command

CONNECT_S: Final = 10.0
_ANY_PORT: Final = "127.0.0.1:0"
DEATHS_MAX: Final = 20  # of workers that had one chunk; more: the chunk is at fault
_LOST: Final = (FutureCancelledError, CommClosedError, asyncio.CancelledError, TimeoutError)


class SchedulerError(UserError):
    """No scheduler answers at the address, or it has ended."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_scheduler"


class WorkersDiedError(UserError):
    """Workers died again and again of one chunk."""

    exit_code = ExitCode.FAILED
    code = "workers_died"


def decode_on_cluster(
    chunks: Sequence[Chunk], job: Job, scheduler: str | None, workers: int
) -> Iterator[dict[str, Any]]:
    """Give the report of each chunk once it is done, in any order.

    Parameters
    ----------
    scheduler
        Address of a scheduler; None: as many processes of this computer as there are `workers`.

    Raises
    ------
    SchedulerError, WorkersDiedError
        The cluster cannot be used, or is lost.
    UsageError
        The address is none.
    UserError
        What `decode_chunk` raises.
    """
    quiet = {"distributed.scheduler.allowed-failures": DEATHS_MAX}
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(quiet))
        if scheduler is None:
            cluster: Any = stack.enter_context(
                LocalCluster(
                    n_workers=workers, threads_per_worker=1, dashboard_address=_ANY_PORT, silence_logs=logging.CRITICAL
                )
            )
        else:
            cluster = scheduler
        client = stack.enter_context(_client(cluster, scheduler))
        futures = client.map(decode_chunk, chunks, job=job, key=[f"decode-{chunk.key}" for chunk in chunks], pure=False)
        stack.callback(client.cancel, futures)
        for future in as_completed(futures, loop=client.loop):
            try:
                yield future.result()
            except KilledWorker as error:
                raise WorkersDiedError(
                    f"{future.key}: its workers died again and again; give them more memory, then repeat the command: "
                    "it goes on with the chunks that are not done"
                ) from error
            except _LOST as error:
                raise _lost(scheduler) from error


def _client(cluster: Any, scheduler: str | None) -> Any:
    try:
        return Client(cluster, timeout=CONNECT_S, set_as_default=False)
    except ValueError as error:
        raise UsageError(f"--scheduler: {scheduler!r} is no address: {error}; as tcp://host:8786") from error
    except (OSError, *_LOST) as error:
        raise SchedulerError(
            f"no scheduler answers at {scheduler} within {CONNECT_S:g} s; start one (dask scheduler), or leave "
            "--scheduler out"
        ) from error


def _lost(scheduler: str | None) -> SchedulerError:
    return SchedulerError(
        f"the scheduler{'' if scheduler is None else f' at {scheduler}'} has ended; repeat the command: it goes on "
        "with the chunks that are not done"
    )
