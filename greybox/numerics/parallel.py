"""One map over independent work: processes of this machine, or a Dask cluster by its address.

Every piece of work carries its own seed, and results come in the order of the pieces, so they
depend neither on how many processes there are nor on which of them computes what.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any, TypeVar

from greybox.errors import ClusterError, UsageError, WorkerError
from greybox.numerics.effort import seconds_left, within
from greybox.numerics.threads import limit_to_one_thread, one_thread

if TYPE_CHECKING:
    from distributed import Client

Piece = TypeVar("Piece")
Result = TypeVar("Result")

ENVIRONMENT = "GREYBOX_CLUSTER"
# workers that may die before work is given up: one may be killed by chance or for the memory that
# others hold, a third one died of the work itself. The schedulers of Dask allow as many
_DEATHS = 3
# seconds within which a scheduler answers, and within which one without workers gets one
_ANSWER, _PATIENCE = 10.0, 60.0
# seconds between looks at whether processes still run, and looks that find none in a row before it
# counts: ended ones are about to be replaced
_LOOK, _LOOKS = 0.5, 10
# seconds for which idle processes are kept: one that ends just when the next work is given is told
# as a fault on the terminal
_KEPT = 300
# names under which Dask reports on what ends as one sentence here
_LOGGERS = ("distributed", "tornado.application")
_log = logging.getLogger(__name__)

_address: ContextVar[str | None] = ContextVar("address", default=None)
# whether this is computed for a cluster, whose own workers are all that there is
_for_cluster: ContextVar[bool] = ContextVar("for_cluster", default=False)
_clients: dict[str, Client] = {}
_one_at_a_time = threading.Lock()
# what the copies of this process are to do: they inherit it, so that it need not be sent
_work: tuple[Callable[[Any], Any], Sequence[Any]] | None = None
# whether this process computes ahead of the first one, and may share that with copies of its own
_is_ahead = False
# prctl's option that asks for a signal once the parent is gone
_PARENT_GONE = 1


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def on_cluster(address: str | None) -> Iterator[None]:
    """Let the maps inside the block be computed by a Dask cluster.

    Parameters
    ----------
    address : str, optional
        Of its scheduler, such as ``tcp://host:8786``; by default that of the environment
        variable ``GREYBOX_CLUSTER``, and without it this machine.

    Raises
    ------
    ClusterError
        There is no scheduler, or it gets no workers.
    UsageError
        A cluster is named but dask.distributed is not installed.
    """
    address = address or os.environ.get(ENVIRONMENT) or None
    token = _address.set(address)
    try:
        if address is not None:
            _client(address)
        yield
    finally:
        _address.reset(token)
        client = _clients.pop(address or "", None)
        if client is not None:
            client.close()


def _first() -> bool:
    """Whether this process is no worker of a map itself: those compute what is inside here."""
    name = multiprocessing.current_process().name
    return not _for_cluster.get() and (_is_ahead or name == "MainProcess")


def _cluster() -> str | None:
    """Return the address of the cluster that is to compute, None where this process is to."""
    if not _first():
        return None
    return _address.get() or os.environ.get(ENVIRONMENT) or None


def lanes() -> int:
    """Return how many pieces `map_forked` computes at a time: 1 where it does so one by one.

    A copy of a process is safe where no other thread runs in it; one of several that a study
    started leaves the other processors to those.
    """
    address = _cluster()
    if address is not None:
        return max(1, len(_client(address).nthreads()))
    return processors() if _may_fork() else 1


def _may_fork() -> bool:
    return sys.platform == "linux" and _first() and len(sys._current_frames()) == 1


def map_pieces(
    function: Callable[[Piece], Result],
    pieces: Iterable[Piece],
    *,
    workers: int | None = None,
) -> Iterator[Result]:
    """Apply a function to independent pieces, results in the order of the pieces.

    Parameters
    ----------
    function : callable
        A module-level function of one piece.
    pieces : iterable
        With their seeds, where there is chance.
    workers : int, optional
        Processes; by default one a processor. 1 computes here. A cluster uses all that it has.

    Raises
    ------
    ClusterError
        The cluster named by `on_cluster` or ``GREYBOX_CLUSTER`` is not there, or is lost.
    WorkerError
        Three workers died.
    """
    work = list(pieces)
    address = _cluster()
    count = min(workers or processors(), len(work))
    if address is not None:
        yield from _by_cluster(address, function, work)
    elif count < 2 or not _first():
        yield from map(function, work)
    elif _may_fork():
        yield from _by_copies(function, work, count)
    else:
        yield from _by_processes(function, work, count)


def map_forked(
    function: Callable[[Piece], Result],
    pieces: Sequence[Piece],
    *,
    workers: int | None = None,
) -> list[Result]:
    """Apply a function to a few heavy pieces of one computation, results in their order.

    Where no cluster computes, it is done in copies of this process, which know all that it
    knows, so function and pieces may be anything; what they change is lost but for the
    results, which must be picklable. Where a process cannot be copied, pieces are computed
    here, one by one.

    Parameters
    ----------
    function : callable
    pieces : sequence
    workers : int, optional
        Processes; by default one a processor. A cluster uses all that it has.

    Raises
    ------
    Exception
        The first one that the function raises.
    """
    address = _cluster()
    if address is not None and len(pieces) > 1:
        return list(_by_cluster(address, function, pieces))
    count = min(workers or lanes(), len(pieces)) if address is None and _may_fork() else 1
    if count < 2:
        return [function(piece) for piece in pieces]
    return list(_by_copies(function, pieces, count))


@contextmanager
def ahead(function: Callable[[], Result]) -> Iterator[Callable[[], Result]]:
    """Let a copy of this process compute what may be needed later, while this one goes on.

    The copy shares its maps with copies of its own. Where a process cannot be copied, or a cluster
    computes, it is computed once it is asked for.

    Parameters
    ----------
    function : callable
        Its result must be picklable.

    Yields
    ------
    callable
        Waits for the result and returns it, each time the same. What was not asked for ends with
        the block.
    """
    if _cluster() is not None or lanes() < 2:
        yield cache(function)
        return
    context = multiprocessing.get_context("fork")
    received, sent = context.Pipe(duplex=False)

    def work(first: int) -> None:
        global _is_ahead
        _begin_copy(first)
        _is_ahead = True
        with suppress(Exception):
            sent.send(function())

    copy = context.Process(target=work, args=(os.getpid(),))
    copy.start()
    sent.close()

    def result() -> Result:
        try:
            found: Result = received.recv()
        except EOFError:
            # what went wrong there goes wrong here, too, and is told
            return function()
        return found

    try:
        yield cache(result)
    finally:
        copy.terminate()
        copy.join()
        received.close()


def _by_copies(
    function: Callable[[Piece], Result], pieces: Sequence[Piece], count: int
) -> Iterator[Result]:
    """Compute pieces in copies of this process."""

    def begin(left: int) -> Executor:
        context = multiprocessing.get_context("fork")
        return ProcessPoolExecutor(min(count, left), context, _begin_copy, (os.getpid(),))

    def give(pool: Executor, k: int) -> Future[Any]:
        global _work
        # all copies are made when the first piece is given
        _work = (function, pieces)
        try:
            return pool.submit(_one, k)
        finally:
            _work = None

    return _collected(begin, give, len(pieces))


def _by_processes(
    function: Callable[[Piece], Result], pieces: Sequence[Piece], count: int
) -> Iterator[Result]:
    """Compute pieces in processes that are begun anew, and kept for the next map."""
    from joblib.externals.loky import get_reusable_executor

    def begin(_: int) -> Executor:
        pool: Executor = get_reusable_executor(
            max_workers=count, timeout=_KEPT, initializer=_begin_worker, initargs=(os.getpid(),)
        )
        return pool

    def give(pool: Executor, k: int) -> Future[Any]:
        return pool.submit(function, pieces[k])

    return _collected(begin, give, len(pieces))


def _one(index: int) -> Any:
    assert _work is not None
    function, pieces = _work
    return function(pieces[index])


def _alone() -> None:
    """Let a worker compute in one thread, and leave Ctrl-C to the first process."""
    limit_to_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _begin_copy(first: int) -> None:
    """Let a copy of a process compute alone, and end with that process."""
    global _is_ahead
    _is_ahead = False
    _alone()
    # without a thread that looks: only a process of one thread can be copied again
    ctypes.CDLL(None).prctl(_PARENT_GONE, signal.SIGKILL)
    if os.getppid() != first:
        os._exit(1)


def _begin_worker(first: int) -> None:
    """Let a process that was begun anew compute alone, and end with the first one."""
    _alone()

    def end_with_first() -> None:
        while os.getppid() == first:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=end_with_first, daemon=True).start()


def _collected(
    begin: Callable[[int], Executor], give: Callable[[Executor, int], Future[Any]], count: int
) -> Iterator[Any]:
    """Yield results in order; what a dead worker was to compute is computed again by new ones."""
    found: dict[int, Any] = {}
    given = deaths = 0
    while given < count:
        left = [k for k in range(given, count) if k not in found]
        here = set(multiprocessing.active_children())
        pool = begin(len(left))
        begun: set[Any] | None = None
        try:
            waiting = {k: give(pool, k) for k in left}
            begun = set(multiprocessing.active_children()) - here
            while given < count:
                if given not in found:
                    found[given] = _worked(pool, waiting.pop(given))
                yield found.pop(given)
                given += 1
        except BrokenProcessPool as error:
            deaths += 1
            done = {k: f for k, f in waiting.items() if f.done() and f.exception() is None}
            found |= {k: f.result() for k, f in done.items()}
            _log.info("a worker died: %d pieces are computed again", len(left) - len(done))
            if deaths == _DEATHS:
                raise WorkerError(
                    f"{deaths} worker processes died, the last while piece {given + 1} of {count} "
                    f"was computed: the system may have ended them for lack of memory; try fewer "
                    f"--workers."
                ) from error
        except BaseException:
            # Ctrl-C may come while the pieces are given
            _stop(pool, set(multiprocessing.active_children()) - here if begun is None else begun)
            raise
    # processes that are kept for the next map stay
    if isinstance(pool, ProcessPoolExecutor):
        pool.shutdown()


def _worked(pool: Any, future: Future[Any]) -> Any:
    """Return a result, unless no worker is left that could make it.

    Raises
    ------
    BrokenProcessPool
        All have ended. Those that are kept end when they have rested for a while, and what is given
        to them at that moment may wait for ever.
    """
    idle = 0
    while not wait([future], timeout=_LOOK).done:
        alive = any(p.is_alive() for p in list((pool._processes or {}).values()))
        idle = 0 if alive else idle + 1
        if idle == _LOOKS:
            _stop(pool, set())
            raise BrokenProcessPool("no worker is left")
    return future.result()


def _stop(pool: Any, begun: set[Any]) -> None:
    """End a pool with its processes, whatever they are at."""
    for process in begun:
        process.terminate()
    if isinstance(pool, ProcessPoolExecutor):
        pool.shutdown(cancel_futures=True)
    else:
        # only the pool knows the processes that an earlier map began
        pool.shutdown(kill_workers=True)


def _client(address: str) -> Client:
    """Return the client of a cluster that is there and has workers, connected once."""
    known = _clients.get(address)
    if known is not None and known.status == "running":
        return known
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise UsageError(
            "a cluster needs dask.distributed: pip install 'greybox-marine[dask]'."
        ) from error
    try:
        # a client that cannot read its address stays half made, and fails again as it is dropped
        get_address_host_port(address)
    except ValueError:
        raise ClusterError(
            f"'{address}' is no address of a Dask scheduler, which names a host and a port: give "
            f"--cluster, or {ENVIRONMENT}, one such as tcp://host:8786."
        ) from None
    for name in _LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_ANSWER, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise ClusterError(
            f"no Dask scheduler answers at '{address}' within {_ANSWER:g} s: start one there with "
            f"'dask scheduler' and workers with 'dask worker {address}', correct the address, or "
            f"leave --cluster and {ENVIRONMENT} out."
        ) from error
    _clients[address] = client
    _require_workers(client, address)
    return client


def _require_workers(client: Client, address: str) -> None:
    """Wait for a worker.

    Raises
    ------
    ClusterError
        None comes.
    """
    end = time.monotonic() + _PATIENCE
    while not client.nthreads():
        if time.monotonic() > end:
            raise ClusterError(
                f"the Dask scheduler at '{address}' has 0 workers and got none within "
                f"{_PATIENCE:g} s: start at least 1 with 'dask worker {address}'."
            )
        time.sleep(0.2)


def _by_cluster(
    address: str, function: Callable[[Piece], Result], pieces: Sequence[Piece]
) -> Iterator[Result]:
    """Compute pieces by a Dask cluster; its scheduler gives those of a dead worker to another."""
    import warnings

    from casadi import global_pickle_context
    from distributed import KilledWorker
    from distributed.protocol.pickle import dumps

    client = _client(address)
    _log.debug("%d pieces are computed at %s", len(pieces), address)
    with global_pickle_context():
        sent = dumps(function)
    futures: list[Any] = []
    try:
        with warnings.catch_warnings():
            # what is sent at once may be large: logs are
            warnings.simplefilter("ignore", UserWarning)
            # the result of a task, unlike what is only sent, is made again if its worker dies
            held = client.submit(bytes, sent, key=f"function-{sha256(sent).hexdigest()}")
            for piece in pieces:
                with global_pickle_context():
                    told = dumps(piece)
                futures.append(client.submit(_remote, held, told, seconds_left(), pure=False))
        for k, future in enumerate(futures):
            yield _awaited(client, address, future)
            # its place at the scheduler is free for others
            futures[k] = None
    except KilledWorker as error:
        raise WorkerError(
            f"more than {_DEATHS} workers of the cluster at '{address}' died of one of "
            f"{len(pieces)} pieces: give workers more memory (dask worker --memory-limit)."
        ) from error
    except (CancelledError, OSError) as error:
        if isinstance(error, OSError) and client.status == "running":
            raise
        raise ClusterError(
            f"the Dask scheduler at '{address}' was lost while {len(pieces)} pieces were computed: "
            f"start it again, and then this command."
        ) from error
    finally:
        with suppress(Exception):
            client.cancel([f for f in futures if f is not None], force=True)


def _awaited(client: Client, address: str, future: Any) -> Any:
    """Return a result; while it is awaited, make sure that there are workers."""
    from casadi import global_unpickle_context
    from distributed import TimeoutError as NotYet
    from distributed.protocol.pickle import loads

    while True:
        try:
            told = future.result(timeout=_PATIENCE)
            break
        except NotYet:
            _require_workers(client, address)
    with global_unpickle_context():
        return loads(told)


def _remote(sent: bytes, piece: bytes, seconds: float) -> bytes:
    """Compute one piece on a worker, within the seconds that are left for it."""
    from casadi import global_pickle_context, global_unpickle_context
    from distributed.protocol.pickle import dumps, loads

    # CasADi and what a process caches know no second thread, which a worker may have
    with _one_at_a_time:
        token = _for_cluster.set(True)
        try:
            with one_thread(), within(seconds):
                with global_unpickle_context():
                    function = loads(sent)
                with global_unpickle_context():
                    given = loads(piece)
                result = function(given)
                with global_pickle_context():
                    return bytes(dumps(result))
        finally:
            _for_cluster.reset(token)
