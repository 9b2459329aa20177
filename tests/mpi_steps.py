"""What tests/test_parallel.py has the ranks of an MPI job do: steps out of a JSON file, one after the other.

    mpirun -n 3 python mpi_steps.py steps.json

A step is [kind, task parameters]; every rank adds its outcome to a file of its own, steps.json.RANK, as one line of
JSON.
"""

import contextlib
import json
import os
import signal
import sys
from unittest import mock

from casa_sara import tsara
from casa_sara.casa.ms import read
from casa_sara.imaging import run_solver
from casa_sara.solver.adaptive_ppd import AdaptivePPD

read._CHUNK = 1500  # small pieces, so that all ranks have some
RANK = int(os.environ.get("OMPI_COMM_WORLD_RANK", os.environ.get("PMI_RANK", "0")))
WHEN = 5  # iteration of what goes wrong


def run(**parameters):
    result = tsara(fullsummary=True, **parameters)
    sara = result["sara"]
    return dict(iterdone=result["iterdone"], stopcode=result["stopcode"], visibilities=sara["visibilities"],
                bounds=[block["l2_bound"] for block in sara["blocks"]], resumed=sara["resumed"],
                noise=[block["noise_measured"] for block in sara["blocks"]], wild=[one["row"] for one in sara["wild"]],
                labels=[[block["samples"], block["scans"], block["start_mjd_s"]] for block in sara["blocks"]],
                dropped=sara["dropped"], averages=sara["averaging"].get("averages"),
                halvings=sara["averaging"].get("halvings"), residual_norm=list(sara["history"]["residual_norm"]))


def stopped(**parameters):
    """A run that rank 0, and no other, is asked to end after some iterations."""
    step, done = AdaptivePPD.step, []

    def counted(ppd):
        step(ppd)
        done.append(ppd.iteration)

    @contextlib.contextmanager
    def stop_soon():
        yield lambda: RANK == 0 and max(done, default=0) >= WHEN

    with mock.patch.object(run_solver, "stop_on_interrupt", stop_soon), mock.patch.object(AdaptivePPD, "step", counted):
        return run(**parameters)


def refused(**parameters):
    try:
        run(**parameters)
    except Exception as error:
        return dict(error=f"{type(error).__name__}: {error}")


def disturbed(happen):
    """A run on whose rank 1 something happens."""
    step = AdaptivePPD.step

    def disturbed_step(ppd):
        if RANK == 1 and ppd.iteration == WHEN:
            happen()
        step(ppd)

    def disturbed_run(**parameters):
        with mock.patch.object(AdaptivePPD, "step", disturbed_step):
            return refused(**parameters)
    return disturbed_run


def fail():
    raise ArithmeticError("rank 1 has had enough")


KINDS = dict(run=run, stopped=stopped, refused=refused, failing=disturbed(fail),
             killed=disturbed(lambda: os.kill(os.getpid(), signal.SIGKILL)))

if __name__ == "__main__":
    with open(sys.argv[1]) as file:
        steps = json.load(file)
    for number, (kind, parameters) in enumerate(steps):
        found = KINDS[kind](**parameters)
        with open(f"{sys.argv[1]}.{RANK}", "a") as file:
            file.write(json.dumps(dict(step=number, **found)) + "\n")
