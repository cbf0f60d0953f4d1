"""Where cases run: processes on this machine, or the workers of a dask cluster; the same calls go to both."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from semrecon.errors import InputError
from semsim.workers import process_pool


@contextmanager
def local(workers: int) -> Iterator[Executor]:
    """Start processes here, which end with this one."""
    with process_pool(workers) as executor:
        yield executor


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Workers of a dask cluster, each of which needs this project and its own copy of real data, if that is used.

    Parameters
    ----------
    address
        Of the scheduler, such as tcp://10.0.0.1:8786.

    Raises
    ------
    InputError
        If dask is not installed, or nobody answers there.
    """
    try:
        from distributed import Client  # an extra
    except ImportError:
        raise InputError("--scheduler needs dask: pip install distributed, here and on the workers") from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"no dask scheduler answers at {address} ({error}); start one with `dask scheduler`") from None
    with client:
        yield client.get_executor(pure=False, retries=3)
