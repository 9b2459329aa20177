"""Tiny simulated MeasurementSets for tests, with an exactly known sky, noise and weights; and the pixels of images.

    from simulated_ms import simulate, column, edit, pixels

    name = simulate(tmp_path / "a.ms", sky=[(1.0, 0.0, 0.0), (0.5, 2e-5, -1e-5)], noise=0.02)
    flags = column(name, "FLAG")
    edit(name, "FLAG", lambda flag: flag | (flag.shape == 0))
    model = pixels("image.model")

A MeasurementSet of a few hundred rows takes about half a second. The casatools simulator lays
out the observation (antennas, uvw, times, tables); the visibilities are predicted here with an
explicit sum over the components, V = Σ S·exp(2πi·(u·l + v·m + w·(n−1))), and everything is
written with the table tool, because the simulator's own noise leaves WEIGHT and SIGMA at 1.
"""

import shutil

import numpy as np

SPEED_OF_LIGHT = 299792458.0
CYGNUS_A = "J2000 19h59m28.5s +40d44m02s"
_TOOLS = {}


def _tool(name):
    """Return one casatools tool of this kind, made at its first use."""
    if name not in _TOOLS:
        import casatools

        _TOOLS[name] = getattr(casatools, name)()
    return _TOOLS[name]


def column(name, col, rows=None):
    """Return a main-table column with the axes (…, row), of all rows or of these ones."""
    tb = _tool("table")
    tb.open(str(name))
    try:
        if rows is None:
            return tb.getcol(col)
        return np.stack([tb.getcell(col, int(row)) for row in rows], axis=-1)
    finally:
        tb.close()


def edit(name, col, change):
    """Replace a column (of the main table, or of `NAME.ms/SUBTABLE`) by `change(column)`.

    Where the rows of a main table differ in shape, `change` is called for the rows of each
    data description in turn.
    """
    tb = _tool("table")
    tb.open(str(name), nomodify=False)
    try:
        shapes = set(tb.getcolshapestring(col)) if tb.isvarcol(col) else {"one"}
        if len(shapes) == 1:
            tb.putcol(col, change(tb.getcol(col)))
            return
        window = tb.getcol("DATA_DESC_ID")
        for number in np.unique(window):
            part = tb.selectrows(np.flatnonzero(window == number).tolist())
            part.putcol(col, change(part.getcol(col)))
            part.close()
    finally:
        tb.close()


def pixels(name):
    """Return the pixels (nx, ny) of the first plane of a CASA image."""
    ia = _tool("image")
    ia.open(str(name))
    try:
        return ia.getchunk()[:, :, 0, 0]
    finally:
        ia.close()


def add_column(name, col, value, like="DATA"):
    """Add an array column described as the existing column `like` and fill it with `value`."""
    tb = _tool("table")
    tb.open(str(name), nomodify=False)
    try:
        description = dict(tb.getcoldesc(like))
        if col.endswith("SPECTRUM"):
            description["valueType"] = "float"
        for key in ("dataManagerGroup", "dataManagerType", "shape"):
            description.pop(key, None)
        description["ndim"], description["option"] = 2, 0
        tb.addcols({col: description})
        if value is not None:
            tb.putcol(col, value)
    finally:
        tb.close()


def remove_columns(name, *cols):
    """Remove main-table columns."""
    tb = _tool("table")
    tb.open(str(name), nomodify=False)
    try:
        tb.removecols(list(cols))
    finally:
        tb.close()


def antenna_positions(configuration, count):
    """Return (3, count) ITRF metres: every k-th VLA antenna of a configuration file."""
    import casatools

    path = casatools.ctsys.resolve(f"alma/simmos/vla.{configuration}.cfg")
    with open(path) as text:
        lines = [line.split() for line in text if line.strip() and not line.startswith("#")]
    xyz = np.array([line[:3] for line in lines], dtype=float).T
    return xyz[:, np.linspace(0, xyz.shape[1] - 1, count).astype(int)]


def direction_cosines(fields, sky):
    """Return (flux, lmn): lmn (field, 3, component) of a sky given around the first field.

    A component is (Jy, l, m): its direction cosines (SIN projection, radians, l to the
    east) as seen from the first field's centre.
    """
    me = _tool("measures")
    flux, l, m = np.array(sky, dtype=float).reshape(-1, 3).T
    bases = []
    for text in fields:
        frame, ra, dec = text.split()
        centre = me.measure(me.direction(frame, ra, dec), "J2000")
        ra, dec = centre["m0"]["value"], centre["m1"]["value"]
        east = [-np.sin(ra), np.cos(ra), 0.0]
        north = [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)]
        towards = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
        bases.append(np.array([east, north, towards]))
    vectors = bases[0].T @ np.array([l, m, np.sqrt(1 - l**2 - m**2)])
    return flux, np.array([basis @ vectors for basis in bases])


def simulate(
    path,
    *,
    configuration="d",
    antennas=8,
    correlations="RR LL",
    fields=(CYGNUS_A,),
    spws=(("8.4GHz", "2MHz", 3),),
    scans=2,
    scan_seconds=60.0,
    integration=10.0,
    spacing_seconds=1800.0,
    hour_angle=-1.0,
    date="2015/06/01",
    frame="LSRK",
    sky=((1.0, 0.0, 0.0),),
    noise=0.0,
    columns=("DATA",),
    weight_spectrum=False,
    autocorrelations=False,
    telescope="VLA",
    seed=0,
):
    """Write the MeasurementSet `path` (replaced when it exists) and return its name.

    Parameters
    ----------
    configuration : 'a', 'b', 'c', 'd', or float array (3, N)
        VLA configuration, of which `antennas` are taken; or ITRF antenna positions in metres.
    correlations : str
        Any list, in any order: 'RR LL', 'LL RR', 'XX YY', 'RR RL LR LL', 'XX'.
    fields : sequence of str
        Phase centres 'FRAME RA DEC'; scan k observes field k modulo their number.
    spws : sequence of (first frequency, channel width, channels)
        All of them are observed in every scan.
    scans, scan_seconds, integration, spacing_seconds, hour_angle, date
        `scans` scans start `spacing_seconds` apart, the first at this hour angle (hours).
    frame : str
        Reference of the channel frequencies. With 'LSRK' nothing depends on Doppler factors;
        the prediction takes the nominal frequencies in any frame.
    sky : sequence of (flux in Jy, l, m)
        Unpolarised point sources, direction cosines around the first field.
    noise : float or one per correlation
        Standard deviation in Jy of Re and of Im. SIGMA is set to it, WEIGHT to 1/SIGMA²;
        both stay 1 where it is 0.
    columns : subset of 'DATA', 'CORRECTED_DATA', 'MODEL_DATA'
        Columns to keep; DATA and CORRECTED_DATA are equal, MODEL_DATA has no noise.
    weight_spectrum : bool
        Add WEIGHT_SPECTRUM, filled with WEIGHT in every channel.
    """
    import casatools

    path = str(path)
    shutil.rmtree(path, ignore_errors=True)
    xyz = antenna_positions(configuration, antennas) if isinstance(configuration, str) else np.asarray(configuration)
    sm, me = casatools.simulator(), _tool("measures")
    sm.open(path)
    try:
        sm.setconfig(
            telescopename=telescope, x=xyz[0], y=xyz[1], z=xyz[2], dishdiameter=[25.0] * xyz.shape[1],
            mount=["alt-az"], antname=[f"A{k:02d}" for k in range(xyz.shape[1])],
            coordsystem="global", referencelocation=me.observatory(telescope),
        )  # fmt: skip
        for number, (freq, width, channels) in enumerate(spws):
            sm.setspwindow(spwname=f"SPW{number}", freq=freq, deltafreq=width, freqresolution=width,
                           nchannels=channels, stokes=correlations, refcode=frame)  # fmt: skip
        sm.setfeed("perfect X Y" if "X" in correlations else "perfect R L", pol=[""])
        for number, text in enumerate(fields):
            sm.setfield(sourcename=f"FIELD{number}", sourcedirection=me.direction(*text.split()))
        sm.setlimits(shadowlimit=0.001, elevationlimit="1deg")
        sm.setauto(autocorrwt=1.0 if autocorrelations else 0.0)
        sm.settimes(integrationtime=f"{integration}s", usehourangle=True, referencetime=me.epoch("UTC", date))
        for scan in range(scans):
            start = hour_angle * 3600 + scan * spacing_seconds
            for number in range(len(spws)):
                sm.observe(f"FIELD{scan % len(fields)}", f"SPW{number}",
                           starttime=f"{start}s", stoptime=f"{start + scan_seconds}s")  # fmt: skip
    finally:
        sm.done()
    _fill(path, fields, sky, noise, seed)
    if weight_spectrum:
        weight, window = column(path, "WEIGHT"), column(path, "DATA_DESC_ID")
        add_column(path, "WEIGHT_SPECTRUM", None)
        spectra = [np.repeat(weight[:, None, window == k], spw[2], axis=1) for k, spw in enumerate(spws)]
        _put(path, {"WEIGHT_SPECTRUM": spectra})
    remove_columns(path, *({"DATA", "CORRECTED_DATA", "MODEL_DATA"} - set(columns)))
    return path


def _put(path, values):
    """Write `values[column]`, a list with one array for the rows of each spectral window."""
    window = column(path, "DATA_DESC_ID")
    tb = _tool("table")
    tb.open(path, nomodify=False)
    try:
        for number in np.unique(window):
            part = tb.selectrows(np.flatnonzero(window == number).tolist())
            for col, arrays in values.items():
                part.putcol(col, arrays[number])
            part.close()
    finally:
        tb.close()


def _fill(path, fields, sky, noise, seed):
    """Predict the sky, add the noise, and set SIGMA, WEIGHT, FLAG and the scan numbers."""
    rng = np.random.default_rng(seed)
    flux, lmn = direction_cosines(fields, sky)
    uvw, field_id, window = (column(path, col) for col in ("UVW", "FIELD_ID", "DATA_DESC_ID"))
    correlations = column(path + "/POLARIZATION", "CORR_TYPE")[:, 0]
    hands = np.isin(correlations, (5, 8, 9, 12))
    sigma = np.broadcast_to(np.asarray(noise, dtype=float), (correlations.size,))[:, None, None]
    models, datas, flags = [], [], []
    for number in range(window.max() + 1):
        rows = window == number
        frequencies = column(path + "/SPECTRAL_WINDOW", "CHAN_FREQ", [number])[:, 0]
        offsets = lmn[field_id[rows]] - np.array([0.0, 0.0, 1.0])[:, None]
        cycles = np.einsum("xr,rxs->rs", uvw[:, rows], offsets) * frequencies[:, None, None] / SPEED_OF_LIGHT
        models.append(hands[:, None, None] * (np.exp(2j * np.pi * cycles) @ flux))
        shape = models[-1].shape
        datas.append(models[-1] + sigma * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)))
        flags.append(np.zeros(shape, dtype=bool))
    _put(path, {"MODEL_DATA": models, "DATA": datas, "CORRECTED_DATA": datas, "FLAG": flags})
    sigma = np.where(sigma > 0, sigma, 1.0)[:, 0]
    edit(path, "SIGMA", lambda old: np.repeat(sigma, old.shape[1], axis=1))
    edit(path, "WEIGHT", lambda old: np.repeat(sigma**-2.0, old.shape[1], axis=1))
    edit(path, "FLAG_ROW", np.zeros_like)
    edit(path, "SCAN_NUMBER", lambda old: 1 + (old - 1) // (window.max() + 1))
