"""One map over independent pieces of work: processes, or a Dask cluster by its address."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from greybox.errors import UsageError
from greybox.numerics.forked import processors

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def map_pieces(
    function: Callable[[Piece], Result],
    pieces: Iterable[Piece],
    *,
    workers: int | None = None,
    cluster: str | None = None,
) -> Iterator[Result]:
    """Apply a function to independent pieces, results in the order of the pieces.

    Parameters
    ----------
    function : callable
        A module-level function of one piece.
    pieces : iterable
    workers : int, optional
        Processes; by default one a processor. 1 runs here.
    cluster : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    UsageError
        A cluster is named but dask.distributed is not installed.
    """
    from joblib import Parallel, delayed, parallel_config

    work = list(pieces)
    options: dict[str, Any] = {"backend": "loky", "n_jobs": workers or processors()}
    if cluster is not None:
        try:
            from distributed import Client
        except ImportError as error:
            raise UsageError(
                "a cluster needs dask.distributed: pip install 'greybox-marine[cluster]'."
            ) from error
        Client(cluster)
        options = {"backend": "dask"}
    elif options["n_jobs"] == 1 or len(work) == 1:
        yield from map(function, work)
        return
    with (
        parallel_config(**options, inner_max_num_threads=1)
        if cluster is None
        else (parallel_config(**options))
    ):
        yield from Parallel(return_as="generator")(delayed(function)(piece) for piece in work)
