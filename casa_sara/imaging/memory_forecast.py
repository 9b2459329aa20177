"""Forecast of the memory of a run, by part, before anything is read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from casa_sara.data.averaging import WORTHWHILE, cell_sides
from casa_sara.data.blocks import SNAPSHOT_SAMPLES
from casa_sara.operators.dictionary import coefficient_bytes
from casa_sara.operators.measurement import grid_bytes
from casa_sara.operators.sky import further_bytes
from casa_sara.options import stacked_shape
from casa_sara.parallel.partition import ALONE
from casa_sara.reconstruction.bootstrap import MOST_GROUPS
from casa_sara.reconstruction.problem import MOST_DOUBLINGS
from casa_sara.runtime.scratch import PIECE

__all__ = ["Forecast", "Workload", "forecast"]

# bytes of one visibility; docs/reliability.md, "Forecast", has the measurement
SAMPLE = 46  # Visibilities: vis, two weights, uvw, row, chan
FREQUENCY = 4  # of a sample, where they are kept
STOKES = 12  # of a sample, of each Stokes parameter beyond the first: vis and weight
READING = 62  # chunks, and one column joined
POINT = 28  # of the operator: NonUniformFFT's Points
PLANNING = 64  # frequencies and factors, while the operator is built
SOLVER = 48  # whitened data, density, preconditioner, dual, Φx̄, Φz, weights
PASSING = 12  # weights of a pass between the iterations
# where visibilities are averaged; the averages have an operator of their own
AVERAGED = 16  # of all: whitened, the numbers of their cells, the density
PARTS = 28  # of all, of a mosaic: place and phase in the part of the image that it sees
AVERAGE = 72  # of an average: that of SOLVER, POINT and the sums of its cell
RENEWING = 24  # of all: residual and its sums
GAINS = 28  # of all: predicted, residual, noise, and what islands in doubt predict
# samples on the disk: of each, of each of the largest block, and of each of a piece that is worked on
HELD, OF_BLOCK, OF_PIECE = 12, 70, 160
FILLED = 0.5  # of the uv cells within reach, at most
WEIGHING = 30  # uv cells and densities
SORTING = 12  # of a cube: channels of the samples, and their order
CHECKPOINT = 16  # the dual and Φz
# image planes, each 4 bytes a pixel
PLANE, SUPPORT = 1.25, 0.5  # primary beam and its mask; of a masked model
NORM, NNLS, SOLVING, WRITING = 8, 4, 9, 10
MATCHED = 13  # of the matched filters, while the support is found
DRAW, DRAWN_PART = 1.5, 0.3  # of a draw of the bootstrap, and the part of the image where a confined model may be
ERRORS = 10  # images of errors, and of the smoothing
MIXED, INDEXED = 2, 8  # of each image where several frequencies are solved for; of their smoothed ones
TURNED = 8  # bytes of a sample of each outlier: its rotation, and once what an image contributes
CONTRIBUTED = 8  # bytes of a sample, of each of these
CUBES, CUBES_OF_ERRORS = 3, 3  # psf, residual and model of each channel; its images of errors
MASK = 1.25  # of each channel of a cube, as it is used and as it is written
DENSITY_CELL = 25  # bytes of one uv cell, in CASA's imager
LIBRARIES = 90_000_000  # compiled code and libraries that come with the first run
REPORT, REPORT_SAMPLE, REPORT_PLANES = 70_000_000, 60, 44  # of drawing, of one visibility, image planes

@dataclass(frozen=True)
class Workload:
    """What memory depends on; `reach` is the largest |u| and |v| in wavelengths, `max_w` the largest |w|.

    `frequencies` tells whether the samples keep theirs, for a spectral index; `band` is the largest |ln(ν/ν0)| where
    that is an image, else 0. A cube has `channels`, and `share` of the samples are in the one with most.
    """

    samples: int
    reach: tuple[float, float]
    shape: tuple[int, int]
    cell_rad: tuple[float, float]
    n_bases: int
    levels: int
    niter: int
    nthreads: int
    precondition: bool = True
    report: bool = False
    gridder: str = "standard"
    max_w: float = 0.0
    frequencies: bool = False
    band: float = 0.0
    channels: int = 0
    share: float = 1.0
    masked: bool = False
    whole: tuple[int, int] = (0, 0)  # samples and bases of all ranks, where others have some and this one writes
    confined: bool = False
    draws: int = 0  # of bootstrap and jackknife
    duals: int = 2  # arrays of coefficients: the dual, its weights, and a scratch of the paper's prior
    averages: bool = False  # visibilities may be averaged
    gainfit: bool = False  # gains are fitted to all of them
    on_disk: bool = False  # and are kept on the disk
    blocks: int = 0  # asked for; 0 for those of the automatic rule
    nterms: int = 1  # images that are solved for together
    outliers: tuple[tuple[int, int], ...] = ()  # shapes of small images beside this one
    stokes: int = 1  # Stokes parameters
    together: int = 1  # of these, as many as are solved side by side

    @classmethod
    def of(cls, volume, grid, options, report=False, band=0.0, ranks=ALONE):
        """The workload of this rank: its share of the data that were counted (`volume`), and the task's parameters.

        It is that of one plane; a cube's is made of it by `dataclasses.replace`.
        """
        writes, bases = ranks.comm.rank == 0, len(options.wavelets)
        return cls(math.ceil(volume.samples * ranks.share), volume.reach, grid.shape, grid.cell_rad,
                   len(ranks.wavelets(options.wavelets)), options.wavelevels, options.niter, options.nthreads,
                   options.precondition, report and writes, grid.gridder, volume.max_w,
                   grid.needs_frequencies, band, masked=grid.masked or bool(grid.outliers),
                   whole=(volume.samples, bases) if writes and ranks.comm.size > 1 else (0, 0),
                   confined=options.method == "tsara" and options.significance > 0 and options.nreweights > 0,
                   draws=options.ndraws + options.jackknife * MOST_GROUPS,
                   duals=3 if options.method == "dabbech2018" else 2,
                   averages=options.averages, gainfit=options.gainfit, nterms=grid.nterms, stokes=len(grid.stokes),
                   together=max(1, len(grid.stokes) - 1) if options.polbound and grid.stokes[0] == "I" else 1,
                   outliers=grid.shapes[1:])

    def memory(self):
        """Return phase → part → bytes, in addition to what the process holds before it reads."""
        if self.on_disk and not self.channels:
            return self._on_disk()
        if self.stokes > 1:
            return self._of_stokes()
        return self._of_cube() if self.channels else self._of_plane()

    def _of_stokes(self):
        """The phases of several Stokes parameters: those solved side by side have all that one alone has of its own."""
        shared = ("libraries", "visibilities", "while reading", "uv grid", "while planning", "wavelet workspace")
        further = {"further Stokes parameters": STOKES * (self.stokes - 1) * self.samples,
                   "their models and residuals": self._planes(2 * self.stokes + 2)}
        return {phase: {part: size * (1 if part in shared else self.together) for part, size in parts.items()} | further
                for phase, parts in replace(self, stokes=1, together=1).memory().items()}

    def _of_cube(self):
        """The phases of the fullest channel, beside all data and the cubes; all is read and written at once."""
        one = replace(self, samples=math.ceil(self.samples * self.share), channels=0).memory()
        one.pop("reading")
        writing = one.pop("writing")
        cubes = CUBES + (self.gridder == "mosaic") + CUBES_OF_ERRORS * bool(self.draws)
        held = {"visibilities of all channels": (SAMPLE + SORTING) * self.samples,
                "cubes": self._planes((PLANE + cubes + MASK * self.masked) * self.channels)}
        if self.draws:
            held["draws of all channels"] = self._drawn() * self.channels
        reading = {"libraries": LIBRARIES, "visibilities": SAMPLE * self.samples,
                   "while reading": READING * self.samples}
        return {"reading": reading, **{phase: parts | held for phase, parts in one.items()},
                "images of a channel": writing | held,
                "writing": {"libraries": LIBRARIES, **held,
                            "process that writes": self._planes((PLANE + cubes + MASK * self.masked + 1)
                                                                * self.channels)}}

    def _on_disk(self):
        """The phases of one plane whose samples are on the disk: those of its averages, beside what is in memory."""
        averages = self.most_averages()
        largest = math.ceil(self.samples / self.blocks) if self.blocks else min(self.samples, SNAPSHOT_SAMPLES)
        held = {"visibilities": HELD * self.samples, "visibilities of a block": OF_BLOCK * largest,
                "visibilities of a piece": OF_PIECE * min(PIECE, self.samples)}
        held |= {"grid of visibilities": self._grid()}
        few = replace(self, samples=averages, on_disk=False, averages=False, precondition=False, whole=(0, 0))
        phases = few._of_plane()
        for name in ("reading", "building the operator"):
            phases.pop(name, None)
        return {phase: parts | held for phase, parts in phases.items()}

    def most_averages(self):
        """Return how many averages there are at most: in half of the enlarged cells, but no more than is worthwhile."""
        v, u, *_ = 2.0**MOST_DOUBLINGS * cell_sides(self.shape, self.cell_rad)
        cells = FILLED * math.pi * (self.reach[0] / u + 1) * (self.reach[1] / v + 1) / 2  # of half an ellipse
        blocks = self.blocks or math.ceil(self.samples / SNAPSHOT_SAMPLES)
        return min(math.ceil(WORTHWHILE * self.samples), math.ceil(cells * blocks))

    def _of_plane(self):
        """The phases of one plane, in their order."""
        data = self._data()
        held = data | {"image planes": self._planes(PLANE)}
        with_operator = held | {"operator": self._operator(self.band)}
        phases = {"reading": data | {"while reading": READING * self.samples}}
        if self.niter > 0:
            phases |= self._solving(held, with_operator)
        phases["writing"] = self._writing(with_operator)
        if self.report:
            phases["report"] = self._reporting()
        return phases

    def _data(self):
        return {"libraries": LIBRARIES, "visibilities": (SAMPLE + FREQUENCY * self.frequencies) * self.samples}

    def _solving(self, held, with_operator):
        """The phases from the density of the samples to the writing of a checkpoint."""
        coefs, workspace = map(sum, zip(*(coefficient_bytes(shape, self.n_bases, self.levels)
                                          for shape in (self.shape, *self.outliers))))
        with_solver = with_operator | self._solver()
        iterating = with_solver | {
            "image planes": self._planes(PLANE + SOLVING * self.nterms + MATCHED * self.confined + self._mixing()),
            "re-weighting": max(RENEWING if self.averages else PASSING, GAINS * self.gainfit) * self.samples,
            "wavelet duals and weights": self.duals * self.nterms * coefs,
            "wavelet workspace": workspace}
        phases = {}
        if self.precondition:
            cells = DENSITY_CELL * self._side() ** 2
            phases["density of samples"] = held | {"uv grid": WEIGHING * self.samples + cells}
        phases["building the operator"] = with_operator | {"while planning": PLANNING * self.samples}
        phases["NNLS"] = with_solver | {"image planes": self._planes(PLANE + max(NORM, NNLS) * self.nterms)}
        phases["iterating"] = iterating
        if self.draws:
            phases["drawing"] = iterating | {"draws": self._drawn() + self._planes(2)}
        if any(self.whole):
            samples, bases = self.whole
            duals_and_weights = 2 * coefficient_bytes(self.shape, bases, self.levels)[0]
            phases["writing a checkpoint"] = iterating | {
                "gathered of all ranks": 2 * (CHECKPOINT * samples + duals_and_weights)}
        return phases

    def _solver(self):
        """What the solver holds of the visibilities: of all of them, or of averages."""
        if not self.averages:
            return {"solver's visibilities": SOLVER * self.samples}
        most = math.ceil(WORTHWHILE * self.samples)
        of_each = AVERAGED + PARTS * (self.gridder == "mosaic")
        return {"solver's visibilities": of_each * self.samples + AVERAGE * most + self._grid()
                + further_bytes(most, self, self.max_w, self.band) + self._spectra(most) + self._elsewhere(most)}

    def _writing(self, with_operator):
        planes = PLANE + WRITING + ERRORS * bool(self.draws) + self._smoothing()
        parts = with_operator | {"while planning": PLANNING * self.samples, "image planes": self._planes(planes)}
        if self.draws:
            parts |= {"draws": self._drawn()}
        return parts | {"operator of flat spectra": self._operator()} if self.frequencies else parts

    def _reporting(self):
        """The report has the operator of all ranks' samples, and draws them."""
        samples = max(self.samples, self.whole[0])
        parts = replace(self, samples=samples, report=False).memory()["writing"]
        del parts["while planning"]
        return parts | {"drawing": REPORT + REPORT_SAMPLE * samples, "image planes": self._planes(REPORT_PLANES)}

    def _operator(self, band=0.0):
        """Bytes of the measurement operator; `band` of an image of spectral indices, 0 for flat spectra."""
        further = further_bytes(self.samples, self, self.max_w, band) + self._spectra(self.samples)
        return POINT * self.samples + self._grid() + further + self._elsewhere(self.samples)

    def _elsewhere(self, samples):
        """Bytes of the operators of outliers, which share the grid of the main image."""
        return ((POINT + TURNED) * len(self.outliers) + TURNED * bool(self.outliers)) * samples + sum(
            further_bytes(samples, replace(self, shape=shape), self.max_w) for shape in self.outliers)

    def _planes(self, count):
        return int(4 * (count + SUPPORT * self.masked) * math.prod(stacked_shape((self.shape, *self.outliers))))

    def _mixing(self):
        """Image planes in which images of several frequencies become orders of the spectra."""
        return MIXED * self.nterms * (self.nterms > 1)

    def _smoothing(self):
        """Image planes of the spectral index."""
        return INDEXED * self.nterms * (self.nterms > 1)

    def _spectra(self, samples):
        """Bytes of the factors of samples on images of several frequencies, and of what one of these contributes."""
        return (CONTRIBUTED + 4 * self.nterms) * samples * (self.nterms > 1)

    def _drawn(self):
        """Bytes of the draws."""
        return self._planes(DRAW * self.draws * self.nterms * (DRAWN_PART if self.confined else 1.0))

    def _side(self):
        cell = min(self.cell_rad)
        return math.ceil(max(n * c for n, c in zip(self.shape, self.cell_rad)) / cell)

    def _grid(self):
        if self.samples == 0:
            return 0
        reach = [min(max(wave * cell, 1e-6), 0.5) for wave, cell in zip(self.reach, self.cell_rad)]
        return grid_bytes(self.samples, reach, self.shape)


@dataclass(frozen=True)
class Forecast:
    """Memory that a workload needs, and what there is.

    Attributes
    ----------
    workload : Workload
    phases : dict
        Phase → part → bytes.
    resident : int
        Bytes that the process holds before.
    room : int
        Bytes that it may take in addition.
    iteration_s : float
        Seconds of one iteration, NaN where it was not measured.
    """

    workload: Workload
    phases: dict[str, dict[str, int]]
    resident: int
    room: int
    iteration_s: float = math.nan

    @property
    def peak_phase(self) -> str:
        """The phase that needs most."""
        return max(self.phases, key=lambda phase: sum(self.phases[phase].values()))

    @property
    def needed(self) -> int:
        """Bytes that the run takes in addition to what the process holds."""
        return sum(self.phases[self.peak_phase].values())

    @property
    def fits(self) -> bool:
        """Whether there is room."""
        return self.needed <= self.room

    def lines(self):
        """The memory as lines of a table, for the log."""
        work, parts = self.workload, self.phases[self.peak_phase]
        yield (f"forecast: {(self.resident + self.needed) / 1e9:.2f} GB of memory at the peak (phase: "
               f"{self.peak_phase}) for {work.shape[0]} x {work.shape[1]} pixels{self._more()} and {work.samples} "
               f"visibilities; {self.resident / 1e9:.2f} GB are in use now, and {self.room / 1e9:.2f} GB more are "
               "available:")
        for part, size in parts.items():
            yield f"  {part:<26}{size / 1e6:10.1f} MB"
        yield f"  {'total':<26}{self.needed / 1e6:10.1f} MB"

    def _more(self):
        outliers = f" and {len(self.workload.outliers)} outliers" if self.workload.outliers else ""
        return outliers + (f" in {self.workload.channels} channels" if self.workload.channels else "")

    def summary(self):
        """Return what the returned dictionary says of it: sizes in bytes."""
        return {
            "imsize": list(self.workload.shape),
            **({"nchan": self.workload.channels} if self.workload.channels else {}),
            **({"outliers": [list(shape) for shape in self.workload.outliers]} if self.workload.outliers else {}),
            "visibilities": self.workload.samples,
            "peak_bytes": self.resident + self.needed,
            "held_before_bytes": self.resident,
            "available_bytes": self.room,
            "fits": self.fits,
            "peak_phase": self.peak_phase,
            "memory_bytes": {phase: dict(parts) for phase, parts in self.phases.items()},
            "iteration_s": self.iteration_s,
        }

    def require(self, maxmem_gb):
        """Raise MemoryError, with what would fit, unless there is room."""
        if self.fits:
            return
        parts = ", ".join(f"{part} {size / 1e9:.2f}" for part, size in self.phases[self.peak_phase].items())
        least = self.resident + self.needed
        limit = f"maxmem = {maxmem_gb:g} GB" if maxmem_gb else "the memory available"
        raise MemoryError(
            f"imsize = {list(self.workload.shape)}{self._more()} with the {self.workload.samples} visibilities of "
            f"vis takes {least / 1e9:.2f} GB while {self.peak_phase} ({parts}, in use now {self.resident / 1e9:.2f}); "
            f"{limit} allows {(self.resident + self.room) / 1e9:.2f} GB. {self._what_fits()}")

    def _what_fits(self):
        """The largest image of this shape, and the most visibilities."""
        work = self.workload

        def needs(changed):
            return replace(self, workload=changed, phases=changed.memory()).fits

        def scaled(part):
            return replace(work, shape=tuple(max(1, int(n * part) // 2 * 2) for n in work.shape))

        part = _largest(lambda x: needs(scaled(x)))
        samples = _largest(lambda x: needs(replace(work, samples=max(1, int(work.samples * x)))))
        ways = []
        if part:
            ways.append(f"imsize up to {list(scaled(part).shape)}")
        fewer = _largest(lambda x: needs(replace(work, channels=max(1, int(work.channels * x)))))
        channels = int(work.channels * fewer)
        if channels:
            ways.append(f"nchan up to {channels}")
        if samples:
            most = int(work.samples * samples)
            ways.append(f"at most {most} visibilities (select with spw, scan, …; or average them)")
        if not ways:
            return "No image fits, however small and with however few visibilities: more memory is needed"
        return f"It would fit with {' or '.join(ways)}; fewer wavelets also take less"


def forecast(workload, resident, available, maxmem_gb=0.0):
    """Forecast the memory of a workload.

    Parameters
    ----------
    workload : Workload
        What the memory depends on.
    resident, available : int
        Bytes held by the process, and those that it can take in addition.
    maxmem_gb : float
        Most that the process may hold, 0 for no such limit.

    Returns
    -------
    Forecast
    """
    room = min(available, int(maxmem_gb * 1e9) - resident) if maxmem_gb else available
    return Forecast(workload, workload.memory(), resident, room)


def _largest(fits):
    """Largest x in (0, 1) that fits, to 1 %; 0 where none does."""
    low, high = 0.0, 1.0
    while high - low > 0.01 * high and high > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
