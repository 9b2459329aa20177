"""Small simulated mosaics of ALMA's 12 m and 7 m dishes, with an exactly known sky, primary beams and noise.

The visibilities are an explicit sum over point sources, each times the product of the voltage patterns of the two
dishes of the baseline: Airy patterns of blocked dishes, as ALMA's are in CASA, written here anew.
"""

import numpy as np
from scipy.special import j1
from simulated_ms import SPEED_OF_LIGHT, column, direction_cosines, edit, simulate

ARCSEC = np.pi / 180 / 3600
ALMA = np.array([2225142.18, -5440307.37, -2481029.85])  # metres, ITRF
CENTRE = (150.0, -30.0)  # degrees
BLOCKAGE = 0.75
EFFECTIVE = {12.0: 10.7, 7.0: 6.25}


def voltage(angle, diameter, freq_hz):
    """The voltage pattern of a blocked dish, to its first null."""
    x = np.maximum(np.pi * EFFECTIVE[diameter] * freq_hz / SPEED_OF_LIGHT * np.sin(angle), 1e-6)
    hole = BLOCKAGE / EFFECTIVE[diameter]
    pattern = (2 * j1(x) / x - hole**2 * 2 * j1(hole * x) / (hole * x)) / (1 - hole**2)
    return np.where((pattern > 0) & (x < 4), pattern, 0.0)


def direction(east_arcsec, north_arcsec):
    """Return the direction 'J2000 RA DEC' at direction cosines from the centre."""
    l, m = east_arcsec * ARCSEC, north_arcsec * ARCSEC
    ra, dec = np.radians(CENTRE)
    n = np.sqrt(1 - l * l - m * m)
    sin_dec = m * np.cos(dec) + n * np.sin(dec)
    right = ra + np.arctan2(l, n * np.cos(dec) - m * np.sin(dec))
    return f"J2000 {float(np.degrees(right))!r}deg {float(np.degrees(np.arcsin(sin_dec)))!r}deg"


def positions(dishes, spread, seed):
    """Return ITRF positions (3, N) of antennas scattered over `spread` metres around ALMA."""
    rng = np.random.default_rng(seed)
    lon, lat = np.arctan2(ALMA[1], ALMA[0]), np.arcsin(ALMA[2] / np.linalg.norm(ALMA))
    east = np.array([-np.sin(lon), np.cos(lon), 0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    # none overlap
    found = []
    while len(found) < len(dishes):
        place = (spread if dishes[len(found)] == 12 else spread / 4) * rng.standard_normal(2)
        if all(np.hypot(*(place - other)) > 13 for other in found):
            found.append(place)
    found = np.array(found).T
    return ALMA[:, None] + np.outer(east, found[0]) + np.outer(north, found[1])


def explicit_sum(uvw, lmn, flux):
    """Return Σ S exp(2πi(ul + vm + w(n − 1))), complex (M,), of uvw (3, M) in wavelengths and places (3, sources)."""
    return np.exp(2j * np.pi * (uvw.T @ (lmn - np.array([0.0, 0.0, 1.0])[:, None]))) @ flux


def predict(name, fields, sky, dishes, fourier_sum=explicit_sum):
    """Return the visibilities of point sources (Jy, l, m) around the centre, by window: complex (channels, rows)."""
    flux, lmn = direction_cosines([f"J2000 {CENTRE[0]!r}deg {CENTRE[1]!r}deg", *fields], sky)
    lmn = lmn[1:]
    uvw, field, window = (column(name, what) for what in ("UVW", "FIELD_ID", "DATA_DESC_ID"))
    ends = np.asarray(dishes)[np.stack([column(name, "ANTENNA1"), column(name, "ANTENNA2")])]
    angle = np.arctan2(np.hypot(lmn[:, 0], lmn[:, 1]), lmn[:, 2])
    made = []
    for number in range(window.max() + 1):
        frequencies = column(name + "/SPECTRAL_WINDOW", "CHAN_FREQ", [number])[:, 0]
        vis = np.zeros((frequencies.size, window.size), complex)
        for chan, freq in enumerate(frequencies):
            patterns = {size: voltage(angle, size, freq) for size in set(dishes)}  # (field, source)
            for k in range(len(fields)):
                for one in set(dishes):
                    for other in set(dishes):
                        here = (field == k) & (ends[0] == one) & (ends[1] == other) & (window == number)
                        seen = flux * patterns[one][k] * patterns[other][k]
                        if here.any():
                            vis[chan, here] = fourier_sum(uvw[:, here] * (freq / SPEED_OF_LIGHT), lmn[k], seen)
        made.append(vis[:, window == number])
    return made


def simulate_mosaic(path, pointings, sky, dishes=(12.0,) * 8 + (7.0,) * 4, noise=0.02, spread=60.0, seed=1,
                    gain_rms=0.0, spws=(("100GHz", "10MHz", 2),), scan_seconds=60.0, integration=20.0, rounds=1,
                    hours=1.0, places=None, fourier_sum=explicit_sum):
    """Write a MeasurementSet of pointings (east, north) in arcsec from the centre, of a sky (Jy, l, m) around it.

    The pointings follow one another, `rounds` times within `hours`.
    `places` (3, N) are the antennas, ITRF in metres; random ones within `spread` metres unless given.
    `noise` in Jy of baselines of two 12 m dishes; of others it grows as the areas of the dishes shrink.
    """
    fields = [direction(*pointing) for pointing in pointings]
    places = positions(dishes, spread, seed) if places is None else places
    name = simulate(path, configuration=places, telescope="ALMA", correlations="XX YY", fields=fields, spws=spws,
                    scans=rounds * len(fields), scan_seconds=scan_seconds, integration=integration, sky=[(1.0, 0, 0)],
                    spacing_seconds=hours * 3600 / (rounds * len(fields)), hour_angle=-hours / 2)
    edit(name + "/ANTENNA", "DISH_DIAMETER", lambda old: np.array(dishes))
    ends = np.asarray(dishes)[np.stack([column(name, "ANTENNA1"), column(name, "ANTENNA2")])]
    sigma = noise * (12.0 / ends[0]) * (12.0 / ends[1])
    rng, made = np.random.default_rng(seed), predict(name, fields, sky, dishes, fourier_sum)
    window, scan = column(name, "DATA_DESC_ID"), column(name, "SCAN_NUMBER")
    gains = 1 + gain_rms / np.sqrt(2) * (rng.standard_normal((scan.max() + 1, len(dishes)))
                                         + 1j * rng.standard_normal((scan.max() + 1, len(dishes))))
    ant = np.stack([column(name, "ANTENNA1"), column(name, "ANTENNA2")])
    error = gains[scan, ant[0]] * np.conj(gains[scan, ant[1]])
    of_window = iter(range(len(spws)))
    order = [np.flatnonzero(window == number) for number in range(len(spws))]

    def data(old):
        rows = order[next(of_window) if len(spws) > 1 else 0]
        vis = np.broadcast_to(made[window[rows[0]]] * error[rows], old.shape).copy()
        return vis + sigma[rows] * (rng.standard_normal(old.shape) + 1j * rng.standard_normal(old.shape))

    edit(name, "DATA", data)
    edit(name, "SIGMA", lambda old: np.repeat(np.where(sigma > 0, sigma, 1)[None], old.shape[0], axis=0))
    edit(name, "WEIGHT", lambda old: np.repeat(np.where(sigma > 0, sigma, 1)[None] ** -2.0, old.shape[0], axis=0))
    return name
