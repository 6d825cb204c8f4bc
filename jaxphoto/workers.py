"""Studies in parts: in this process, or on the workers of a Dask scheduler (extra `cluster`).

A study is data with a method `compute` that returns the result of a part as arrays. It travels once to the scheduler,
which passes it on; each worker keeps it, with what it compiled. Results return to this process, which writes all files,
so the machines need no common file system. Results do not depend on the number of workers or their order.
"""

import hashlib
import io
import logging
import os
import pickle
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

import jax

from jaxphoto.errors import InputError
from jaxphoto.optional import extra

if TYPE_CHECKING:
    from distributed import Client

# Number of parts per worker or thread that are computed or wait for it: none of them waits for the next part.
_AHEAD = 2
# Of a local cluster: number of workers that may die while they compute a part (more, and the part is too large);
# processes that wake up 50 times per second and a profiler nobody reads would take 7 % of a core with two workers.
_LOCAL = {
    "distributed.scheduler.allowed-failures": 10, "distributed.worker.memory.terminate": False,
    "distributed.admin.tick.interval": "1s", "distributed.worker.profile.enabled": False,
}  # fmt: skip
# Runs in each worker before it imports JAX: divide the cores among the workers of this machine.
_PIN = """
import os

def dask_setup(worker):
    if hasattr(os, "sched_setaffinity"):
        cores, workers = sorted(os.sched_getaffinity(0)), {workers}
        own = int(worker.name) % min(workers, len(cores))
        os.sched_setaffinity(0, cores[own :: workers] or [cores[own]])
"""
# One thread per core: pools of BLAS would fight XLA's own (docs/solver.md).
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class Study(Protocol):
    """Computation in independent parts; it is pickled for other processes."""

    def compute(self, part: Any) -> Any:
        """Return the result of a part, as NumPy arrays."""


def in_parts(
    study: Study, parts: Iterable[tuple[int, Any]], client: "Client | None" = None, threads: int = 1
) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each numbered part as it is computed.

    Without a `client` of a Dask scheduler, the parts are computed here, in some `threads`. Raises InputError if the
    scheduler or its workers are lost.
    """
    if client is None:
        yield from _in_threads(study, iter(parts), threads)
        return
    with extra():
        import dask
        from distributed import KilledWorker, as_completed
        from distributed.comm import CommClosedError
    waiting, pickled, numbers = iter(parts), _pickled(study), dict[Any, int]()
    # Workers keep what they compiled for the next call with the same study.
    name = hashlib.sha256(pickled).hexdigest()
    # As the result of a task, unlike scattered data, the study survives the death of the worker that holds it.
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TB"}):
        sent = client.submit(bytes, pickled, key=f"study-{name}")

    def submit() -> list[Any]:
        """Submit parts up to the number that the present workers need."""
        if client.status != "running":
            raise CommClosedError(f"the connection is {client.status}")
        count = max(1, _AHEAD * len(client.nthreads()) - len(numbers))
        new = {client.submit(_compute, name, sent, _pickled(p), pure=False): k for k, p in islice(waiting, count)}
        numbers.update(new)
        return list(new)

    try:
        running = as_completed(submit())
        for future in running:
            number = numbers.pop(future)
            for following in submit():
                running.add(following)
            if future.status == "error":
                raise future.exception()
            yield number, future.result()
    except KilledWorker:
        raise InputError(
            "several workers died while they computed one part, perhaps for lack of memory: use fewer workers per "
            "machine. Finished parts are kept; repeat the command to continue"
        ) from None
    except (CommClosedError, CancelledError) as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(
            f"the connection to the Dask scheduler is lost ({why}): start it, and repeat the command to continue; "
            "finished parts are kept"
        ) from None
    finally:
        for future in numbers:
            future.release()


def _in_threads(study: Study, parts: Iterator[tuple[int, Any]], threads: int) -> Iterator[tuple[int, Any]]:
    """Yield the results of all parts computed in this process."""
    # The first part compiles; with one thread, it is followed by all others.
    for number, part in parts if threads == 1 else islice(parts, 1):
        yield number, study.compute(part)
    running = dict[Future[Any], int]()
    with ThreadPoolExecutor(threads) as pool:
        try:
            while True:
                new = islice(parts, _AHEAD * threads - len(running))
                running |= {pool.submit(study.compute, part): number for number, part in new}
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(future), future.result()
        finally:
            for future in running:
                future.cancel()


def _pickled(value: Any) -> bytes:
    """Pickle a study or a part; functions that cannot be imported by name as code."""
    # Dask requires it.
    import cloudpickle

    class Pickler(cloudpickle.Pickler):
        """Pickle structures of trees by a tree: their own pickle breaks modules of equinox."""

        def reducer_override(self, value: Any) -> Any:
            if isinstance(value, jax.tree_util.PyTreeDef):
                return jax.tree.structure, (jax.tree.unflatten(value, [0] * value.num_leaves),)
            return super().reducer_override(value)

    with io.BytesIO() as buffer:
        Pickler(buffer).dump(value)
        return buffer.getvalue()


_studies: dict[str, Study] = {}
_one_at_a_time = Lock()


def _compute(name: str, pickled: bytes, part: bytes) -> Any:
    """Compute a part in a worker, which keeps the last study."""
    # A worker may have several threads.
    with _one_at_a_time:
        if name not in _studies:
            _studies.clear()
            _studies[name] = pickle.loads(pickled)
        study = _studies[name]
    return study.compute(pickle.loads(part))


@contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator["Client | None"]:
    """Yield a client of a new local cluster of `workers`, or of the scheduler at an address; None without both.

    Raises InputError for both, for an address that is neither encrypted (tls://) nor on this machine, and without a
    scheduler.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers starts a scheduler of its own: omit it or --scheduler")
    if workers is None and scheduler is None:
        yield None
        return
    with extra():
        import dask
        from distributed import Client, LocalCluster
    if scheduler is not None:
        at = urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}")
        if at.scheme != "tls" and at.hostname not in ("localhost", "127.0.0.1", "::1"):
            raise InputError(
                f"{scheduler}: data would travel unencrypted; use a tls:// address (docs/cluster.md), or one of this "
                "machine (tcp://127.0.0.1:8786, such as that of an SSH tunnel)"
            )
        try:
            client = Client(scheduler, timeout="20s")
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"no Dask scheduler answers at {scheduler} ({error}): start it, or correct the address"
            ) from None
        # `in_parts` reports a lost scheduler.
        log = logging.getLogger("distributed.client")
        level = log.level
        log.setLevel(logging.CRITICAL)
        try:
            with client:
                yield client
        finally:
            log.setLevel(level)
        return
    count = workers or 1
    environment = _ENVIRONMENT | {"JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu")}
    with (
        dask.config.set(_LOCAL),
        LocalCluster(
            n_workers=count, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0", memory_limit=0,
            silence_logs=logging.ERROR, preload=[_PIN.format(workers=count)], env=environment,
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        yield client
