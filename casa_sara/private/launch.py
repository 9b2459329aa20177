"""Two ways into a parallel run: every rank calls the task, or casampi's client has its servers do it."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from typing import Any

from casa_sara.casa.runtime import log
from casa_sara.parallel.mpi import MPI, world

__all__ = ["in_parallel", "serve"]


def in_parallel(run: Callable, parameters: dict[str, Any]) -> dict[str, Any]:
    """Run the task on all ranks and return the same on each.

    Where casampi is in charge (mpicasa, or mpirun with casampi installed) only its client comes here: its other
    processes wait for commands from the moment casatasks is imported.

    Raises
    ------
    ValueError
        There is no MPI; the message says what to install and how to start.
    """
    servers = _servers()
    if servers:
        return _push(servers, run, parameters)
    return _run_on(world(), run, parameters)


def serve(run: Callable, parameters: dict[str, Any], servers: list[int],
          folder: str) -> tuple[Any, BaseException | None]:
    """Run the task on casampi's servers: what the client has each of them call. Errors are returned, not raised."""
    from mpi4py import MPI as mpi

    os.chdir(folder)
    group = mpi.COMM_WORLD.Get_group().Incl(servers)
    try:
        return _run_on(MPI(mpi.COMM_WORLD.Create_group(group)), run, parameters), None
    except Exception as error:
        return None, error


def _run_on(comm, run, parameters):
    with comm.guarded():
        log.speak(comm.rank == 0)
        try:
            return run(parameters, comm)
        finally:
            log.speak(True)


def _servers():
    """Return the ranks of casampi's servers, [] where casampi is not in charge."""
    if importlib.util.find_spec("casampi") is None:
        return []
    from casampi.MPIEnvironment import MPIEnvironment

    return MPIEnvironment.mpi_server_rank_list() if MPIEnvironment.is_mpi_enabled else []


def _push(servers, run, parameters):
    """Have the servers run the task, as tclean does, and return what the first of them returns."""
    from casampi.MPICommandClient import MPICommandClient

    client = MPICommandClient()
    client.set_log_mode("redirect")
    client.start_services()
    task = f"__import__({run.__module__!r}, fromlist=[{run.__name__!r}]).{run.__name__}"
    command = (f"__import__({__name__!r}, fromlist=['serve'])"
               f".serve({task}, {parameters!r}, {servers!r}, {os.getcwd()!r})")
    answers = client.push_command_request(command, block=True, target_server=servers)
    failed = [answer for answer in answers if not answer["successful"]]
    if failed:
        raise RuntimeError(f"parallel = True: server {failed[0]['server']} of casampi failed: {failed[0]['traceback']}")
    result, error = answers[0]["ret"]
    if error is not None:
        raise error
    return result
