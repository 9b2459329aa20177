"""What tests/test_cube_parallel.py has the ranks of an MPI job do, step by step, out of a JSON file.

    mpirun -n 2 python cube_mpi_steps.py steps.json

A step is [kind, task parameters]; every rank writes what it found to steps.json.RANK, a line of JSON each.
"""

import json
import os
import signal
import sys
from unittest import mock

from casa_sara import tsara
from casa_sara.solver.adaptive_ppd import AdaptivePPD

RANK = int(os.environ.get("OMPI_COMM_WORLD_RANK", os.environ.get("PMI_RANK", "0")))
WHEN = 150  # the step of rank 0 at which it is asked to stop, or rank 1 fails


def run(**parameters):
    result = tsara(**parameters)
    return dict(stopcode=result["stopcode"], iterdone=result["iterdone"], notes=result["sara"]["notes"],
                codes=[channel.get("stopcode") for channel in result["sara"]["channels"]])


def counting(rank, happen):
    """A run in which something happens at a step of a rank."""
    step, done = AdaptivePPD.step, []

    def counted(ppd):
        step(ppd)
        done.append(1)
        if len(done) == WHEN and RANK == rank:
            happen()

    def counted_run(**parameters):
        done.clear()
        with mock.patch.object(AdaptivePPD, "step", counted):
            try:
                return run(**parameters)
            except ArithmeticError as error:
                return dict(error=str(error))
    return counted_run


def fail():
    raise ArithmeticError("rank 1 has had enough")


KINDS = dict(run=run, stopped=counting(0, lambda: os.kill(os.getpid(), signal.SIGTERM)), failing=counting(1, fail))

if __name__ == "__main__":
    with open(sys.argv[1]) as file:
        steps = json.load(file)
    for kind, parameters in steps:
        found = KINDS[kind](**parameters)
        with open(f"{sys.argv[1]}.{RANK}", "a") as file:
            file.write(json.dumps(found) + "\n")
