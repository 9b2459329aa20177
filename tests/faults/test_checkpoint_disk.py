"""A disk that fills while checkpoints are written: the run matters more."""

import pytest
from machinery import fill, free_bytes, small_disk
from simulated_ms import simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.runtime import log
from casa_sara.reconstruction import checkpoint
from casa_sara.solver.record import ITERATION_LIMIT

GRID = dict(imsize=64, cell="1arcsec", datacolumn="data", nthreads=1)


def test_a_run_goes_on_where_the_disk_has_no_room_for_its_checkpoint(tmp_path, monkeypatch):
    vis = simulate(tmp_path / "c.ms", configuration="c", antennas=8, noise=0.05, seed=4)
    warned = []
    monkeypatch.setattr(checkpoint, "INTERVAL", 0)
    monkeypatch.setattr(checkpoint, "PATIENCE", 0)
    monkeypatch.setattr(log, "warn", warned.append)
    with small_disk(tmp_path / "disk", 8_000) as disk:

        class Progress(log.Progress):
            def __call__(self, iteration, *args):
                if iteration == 5:
                    fill(disk, 100_000)
                if iteration == 9:
                    (disk / "filler").unlink()

        monkeypatch.setattr(log, "Progress", Progress)
        result = tsara(vis=vis, imagename=str(disk / "source"), niter=12, **GRID)
        assert result["stopcode"] == ITERATION_LIMIT and result["iterdone"] == 12
        failed = [line for line in warned if "could not be written" in line]
        assert [line.split(" could")[0] for line in failed] == [f"the checkpoint of iteration {k}"
                                                                for k in (5, 6, 7, 8)]
        assert all("No space left" in line for line in failed)
        assert {path.suffix for path in disk.iterdir()} == {
            ".image", ".model", ".psf", ".residual", ".pb", ".sumwt", ".json"}
        assert free_bytes(disk) > 4_000_000
