"""Simulated MeasurementSets: the casatools simulator lays out the rows, numpy fills in the visibilities.

The prediction is exact to 1e-9 of the total flux (the simulator's own image degridder is good to 0.5 % only), the
noise agrees with SIGMA and WEIGHT, and everything that was added is kept for comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from casatools import ctsys, measures, simulator, table

from casa_sara.demo.predict import predict
from casa_sara.demo.sky import ARCSEC, Sky

__all__ = ["Block", "Observation", "Simulation", "antennas", "gain_errors", "simulate_observation"]

SPEED_OF_LIGHT = 299_792_458.0


@dataclass(frozen=True)
class Observation:
    """How one configuration after the other observes the sky.

    Attributes
    ----------
    antenna_file : str
        CASA antenna file with `{}` in place of the configuration's name, e.g. 'alma/simmos/{}.cfg'.
    hour_angles : (float, float)
        Range in hours over which the scans of all configurations are spread, interleaved.
    scans, integrations, integration_s :
        Scans per configuration (one number for all, or one for each), integrations per scan and their length.
    noise_scale, weight_scale : tuple of float
        For each configuration, a factor on its noise, and one on its WEIGHT that the noise does not
        follow (wrong weights); empty for ones.
    pointing_rms : float
        Pointing errors, a direction-dependent error: the gain of each antenna in each scan grows linearly
        across the image, by this much (rms) from its centre to its edge, independently along both axes.
    """

    telescope: str = "VLA"
    antenna_file: str = "alma/simmos/vla.{}.cfg"
    source: str = "CYGA"
    direction: tuple[str, str] = ("19h59m28.356s", "40d44m02.10s")
    freq_hz: float = 8.4e9
    channel_hz: float = 128e6
    channels: int = 4
    correlations: str = "RR LL"
    hour_angles: tuple[float, float] = (-5.0, 5.0)
    scans: int | tuple[int, ...] = 3
    integrations: int = 6
    integration_s: float = 10.0
    noise_scale: tuple[float, ...] = ()
    weight_scale: tuple[float, ...] = ()
    pointing_rms: float = 0.0

    @property
    def phasecenter(self) -> str:
        """The field centre as tclean takes it."""
        return "J2000 " + " ".join(self.direction)

    @property
    def channel_freqs_hz(self) -> np.ndarray:
        """LSRK channel frequencies, float64 (channels,)."""
        return self.freq_hz + (np.arange(self.channels) - (self.channels - 1) / 2) * self.channel_hz


@dataclass(frozen=True)
class Block:
    """One snapshot (a scan of one MeasurementSet) and the norms of what its Stokes I samples hold.

    All norms are of whitened samples, √w·V with w = 4/(1/w_RR + 1/w_LL) from the WEIGHT column: of the true
    visibilities, of the noise, of the gain errors (pointing errors among them), and of noise and gain errors together.
    """

    ms: str
    scan: int
    samples: int
    signal: float
    noise: float
    gain: float
    error: float


@dataclass
class Simulation:
    """What was simulated: MeasurementSets, the truth on the image's grid, and the errors that were added.

    `truth` is float64 (nx, ny) in Jy/pixel; `noise_std` is the noise of Re and of Im of a
    Stokes I sample in Jy, for each MeasurementSet.
    """

    vis: list[str]
    truth: np.ndarray
    cell_arcsec: float
    phasecenter: str
    noise_std: list[float] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)


def simulate_observation(
    out_dir: str | Path,
    sky: Sky,
    configs: Sequence[str] = "ABCD",
    noise_db: float = 35.0,
    gain_rms: float = 0.0,
    seed: int = 0,
    observation: Observation = Observation(),
) -> Simulation:
    """Observe `sky` with several configurations and write one MeasurementSet for each.

    Parameters
    ----------
    out_dir : str or Path
        Existing folder; `<config>.ms` must not exist in it.
    sky : Sky
        The model of the sky.
    configs : sequence of str
        Names of the configurations, filled (in lower case) into `observation.antenna_file`.
    noise_db : float
        Input SNR 20 log10(‖V‖/‖n‖) over the Stokes I samples of all configurations; inf for no noise.
    gain_rms : float
        Rms of the amplitude errors, and in radians of the phase errors, of the gain of each antenna in
        each scan, common to both hands.
    seed : int
        The same seed gives the same gains whatever the noise is.
    observation : Observation
        Source, frequency and times of the observation.

    Returns
    -------
    Simulation

    Raises
    ------
    FileExistsError
        If a MeasurementSet is there already.
    """
    observed = []
    for number, config in enumerate(configs):
        vis = Path(out_dir) / f"{config}.ms"
        if vis.exists():
            raise FileExistsError(f"{vis} exists: simulate_observation does not overwrite")
        start, scans = (number + 0.5) / len(configs), int(np.broadcast_to(observation.scans, len(configs))[number])
        _lay_out(vis, config, (start + np.arange(scans)) / scans, observation)
        observed.append(_Rows(vis, sky, observation))

    noise_scale = observation.noise_scale or (1.0,) * len(configs)
    weight_scale = observation.weight_scale or (1.0,) * len(configs)
    power = sum(np.sum(np.abs(rows.signal) ** 2) for rows in observed)
    unit = sum(2 * scale**2 * rows.signal.size for rows, scale in zip(observed, noise_scale))
    std = np.sqrt(power / unit) * 10 ** (-noise_db / 20)  # of Re and of Im, Stokes I

    cell = sky.cell_rad * sky.oversampling / ARCSEC
    simulation = Simulation([str(rows.vis) for rows in observed], sky.truth(), cell, observation.phasecenter)
    for number, rows in enumerate(observed):
        simulation.noise_std.append(float(std * noise_scale[number]))
        simulation.blocks += rows.corrupt(simulation.noise_std[-1], weight_scale[number], gain_rms, [seed, number])
    return simulation


class _Rows:
    """The rows of one MeasurementSet with their true visibilities, (channels, rows)."""

    def __init__(self, vis: Path, sky: Sky, observation: Observation):
        self.vis = vis
        self.table = table()
        self.table.open(str(vis), nomodify=False)
        # a plain MeasurementSet: the simulator's empty CORRECTED_DATA would be imaged in place of DATA
        self.table.removecols(["MODEL_DATA", "CORRECTED_DATA"])
        self.antennas = self.table.getcol("ANTENNA1"), self.table.getcol("ANTENNA2")
        self.scan = self.table.getcol("SCAN_NUMBER")
        uvw_m = self.table.getcol("UVW")
        inverse_wavelength = observation.channel_freqs_hz / SPEED_OF_LIGHT
        uvw = (uvw_m[:, None, :] * inverse_wavelength[:, None]).reshape(3, -1)
        if sky.index is None:
            self.signal = predict(sky, uvw).reshape(inverse_wavelength.size, -1)
        else:
            self.signal = np.array([predict(sky.at(freq), uvw_m / (SPEED_OF_LIGHT / freq))
                                    for freq in observation.channel_freqs_hz])
        self.pointing_rms = observation.pointing_rms
        self.slopes = [] if not self.pointing_rms else [
            predict(tilted, uvw).reshape(self.signal.shape) for tilted in _tilted(sky)]

    def corrupt(self, noise_std: float, weight_scale: float, gain_rms: float, seed: list[int]) -> list[Block]:
        """Write visibilities with gain errors and noise, SIGMA and WEIGHT; return what each scan got."""
        shape = self.scan.max() + 1, max(a.max() for a in self.antennas) + 1
        gains = gain_errors(gain_rms, shape, seed)
        first, second = (gains[self.scan, antenna] for antenna in self.antennas)
        gain_error = self.signal * (first * second.conj() - 1)
        pointing = np.random.default_rng([*seed, 3])
        for slope in self.slopes:
            offsets = self.pointing_rms * pointing.standard_normal(shape)
            gain_error += slope * sum(offsets[self.scan, antenna] for antenna in self.antennas)

        sigma = np.sqrt(2) * noise_std  # of one hand
        draw = np.random.default_rng([*seed, 2]).standard_normal((2, 2, *self.signal.shape))
        noise = sigma * (draw[0] + 1j * draw[1])  # (hand, channel, row)
        weight = weight_scale / sigma**2 if sigma > 0 else 1.0

        self.table.putcol("DATA", (self.signal + gain_error + noise).astype(np.complex64))
        self.table.putcol("SIGMA", np.full((2, self.scan.size), weight**-0.5))
        self.table.putcol("WEIGHT", np.full((2, self.scan.size), weight))
        self.table.close()

        noise = np.sqrt(2 * weight) * noise.mean(axis=0)
        gain_error = np.sqrt(2 * weight) * gain_error
        blocks = []
        for scan in np.unique(self.scan):
            of = self.scan == scan
            norms = [float(np.linalg.norm(x[:, of])) for x in (noise, gain_error, noise + gain_error)]
            signal = float(np.sqrt(2 * weight) * np.linalg.norm(self.signal[:, of]))
            blocks.append(Block(str(self.vis), int(scan), int(of.sum()) * self.signal.shape[0], signal, *norms))
        return blocks


def gain_errors(gain_rms: float, shape: tuple[int, int], seed: list[int]) -> np.ndarray:
    """Return the gains, complex (scan, antenna), of a MeasurementSet; `seed`: the observation's, its own number."""
    gain = np.random.default_rng([*seed, 1])
    return (1 + gain_rms * gain.standard_normal(shape)) * np.exp(1j * gain_rms * gain.standard_normal(shape))


def _tilted(sky: Sky) -> list[Sky]:
    """Return the sky times a gain that grows linearly from 0 at its centre to 1 at its edge, along each axis."""
    nx, ny = sky.image.shape
    half = nx / 2 * sky.cell_rad, ny / 2 * sky.cell_rad
    ramps = np.meshgrid((nx // 2 - np.arange(nx)) / (nx / 2), (np.arange(ny) - ny // 2) / (ny / 2), indexing="ij")
    return [
        replace(sky, image=sky.image * ramp, points=sky.points * np.array([1, 1, 0]) + np.outer(
            sky.points[:, axis] / half[axis] * sky.points[:, 2], [0, 0, 1]))
        for axis, ramp in enumerate(ramps)
    ]  # fmt: skip


def _lay_out(vis: Path, config: str, phases: np.ndarray, observation: Observation) -> None:
    """Write a MeasurementSet without signal; its scans start at `phases` (0 … 1) of the range of hour angles."""
    (x, y, z, diameter), names, system = antennas(observation, config)
    me, sm = measures(), simulator()
    sm.open(str(vis))
    try:
        sm.setconfig(
            telescopename=observation.telescope, x=x, y=y, z=z, dishdiameter=diameter, mount=["alt-az"],
            antname=names, coordsystem=system, referencelocation=me.observatory(observation.telescope),
        )  # fmt: skip
        width = f"{observation.channel_hz}Hz"
        sm.setspwindow(
            spwname="band", freq=f"{observation.channel_freqs_hz[0]}Hz", deltafreq=width, freqresolution=width,
            nchannels=observation.channels, stokes=observation.correlations, refcode="LSRK",
        )  # fmt: skip
        sm.setfeed("perfect R L" if observation.correlations[0] == "R" else "perfect X Y")
        sm.setfield(sourcename=observation.source, sourcedirection=me.direction("J2000", *observation.direction))
        sm.setlimits(shadowlimit=1e-6, elevationlimit="8deg")
        sm.setauto(autocorrwt=0.0)
        integration = f"{observation.integration_s}s"
        sm.settimes(integrationtime=integration, usehourangle=True, referencetime=me.epoch("UTC", "2019/08/01"))
        first, last = observation.hour_angles
        for phase in phases:
            start = 3600 * (first + phase * (last - first))
            stop = start + observation.integrations * observation.integration_s
            sm.observe(observation.source, "band", starttime=f"{start}s", stoptime=f"{stop}s")
    finally:
        sm.close()


def antennas(observation: Observation, config: str) -> tuple[np.ndarray, list[str], str]:
    """Read a CASA antenna file: x, y, z and diameter in m (4, n), pad names, and the system of the coordinates."""
    lines = Path(ctsys.resolve(observation.antenna_file.format(config.lower()))).read_text().splitlines()
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    names = [row[4] if len(row) > 4 else f"A{number:03d}" for number, row in enumerate(rows)]
    system = "local" if any(line.startswith("#") and "coordsys=LOC" in line for line in lines) else "global"
    return np.array([row[:4] for row in rows], float).T, names, system
