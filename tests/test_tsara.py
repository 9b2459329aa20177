"""The task as a user calls it: MeasurementSet in, CASA images and a dictionary out."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from simulated_ms import edit, pixels, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.runtime import jsonfile
from casa_sara.solver.record import CONVERGED, ITERATION_LIMIT, NOISE_ONLY, STOPPED_BY_USER

CELL_RAD = np.radians(1.0 / 3600)
# an 8-arcsec extended source of many components, and two point sources; VLA C at 8.4 GHz, beam about 3 arcsec
SKY = [(1.0, -12 * CELL_RAD, 7 * CELL_RAD), (0.4, 9 * CELL_RAD, -10 * CELL_RAD)] + [
    (0.02, x * CELL_RAD, y * CELL_RAD) for x in range(-4, 5, 2) for y in range(-4, 5, 2)
]
FLUX = sum(component[0] for component in SKY)
PRODUCTS = ("model", "psf", "residual", "image", "sumwt", "pb")
RECORD = "source.sara.json"
GRID = dict(imsize=128, cell="0.5arcsec", datacolumn="data")


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=18, sky=SKY, noise=0.05,
                    scans=4,
                    integration=20.0, spacing_seconds=5400.0, hour_angle=-2.5, seed=4)


@pytest.fixture(scope="module")
def run(vis, tmp_path_factory):
    """One default run: its return dictionary and imagename, and the hashes of the MS before and after."""
    name = str(tmp_path_factory.mktemp("run") / "source")
    before = _hashes(vis)
    result = tsara(vis=vis, imagename=name, fullsummary=True, **GRID)
    return result, name, before, _hashes(vis)


@pytest.fixture
def copy(vis, tmp_path):
    """A copy of the MeasurementSet that a test may spoil."""
    return shutil.copytree(vis, tmp_path / "copy.ms")


def _hashes(folder):
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in Path(folder).rglob("*") if path.is_file()}


def test_the_model_is_the_sky(run):
    result, name, *_ = run
    model = pixels(name + ".model")
    assert result["stopcode"] == CONVERGED and result["stopDescription"] == "converged"
    assert model.min() > -0.03 * model.max()  # beside a bright source the bound may have given way
    assert model.sum() == pytest.approx(FLUX, rel=0.03)
    # the brighter point source: flux and place, index = 64 − l/cell, 64 + m/cell
    box = model[84:93, 74:83]
    assert box.sum() == pytest.approx(1.0, rel=0.03)
    assert np.unravel_index(np.argmax(model), model.shape) == (88, 78)


def test_products_are_there_whole_and_finite(run):
    _, name, *_ = run
    for product in PRODUCTS:
        assert np.isfinite(pixels(f"{name}.{product}")).all(), product
    assert sorted(path.name
                  for path in Path(name).parent.iterdir()) == sorted([RECORD, *(f"source.{p}" for p in PRODUCTS)])
    assert pixels(name + ".psf").max() == pytest.approx(1.0, abs=1e-5)
    # restored image: the model in the beam and the residual; noise of the residual is the thermal one
    residual = pixels(name + ".residual")
    assert residual.std() < 3 * run[0]["sara"]["chosen"]["noise_jy_per_beam"]


def test_the_measurement_set_is_untouched(run):
    _, _, before, after = run
    assert before == after


def test_the_dictionary_is_tcleans_with_a_sara_record(run):
    result, *_ = run
    assert {"iterdone", "niter", "nmajordone", "stopcode", "stopDescription", "summarymajor",
            "summaryminor"} <= set(result)
    assert set(result["summaryminor"][0][0][0]) >= {"iterDone", "peakRes", "modelFlux"}
    sara = result["sara"]
    assert [block["scans"] for block in sara["blocks"]] == [[1], [2], [3], [4]]
    for block in sara["blocks"]:
        assert block["noise_found"] == pytest.approx(1.0, rel=0.1)  # thermal noise, right weights
        assert block["noise_measured"] == pytest.approx(1.0, rel=0.1)
    assert set(sara["chosen"]) == set(sara["why"])
    assert sara["history"]["iteration"].size == result["iterdone"]
    assert sara["bounds"][0]["iteration"] == 0 and len(sara["reweightings"]) > 3


def test_the_record_is_kept_beside_the_images(run):
    result, name, *_ = run
    kept = json.loads(Path(name + ".sara.json").read_text())
    assert kept.keys() == result["sara"].keys()
    assert kept["history"]["residual_norm"] == result["sara"]["history"]["residual_norm"].tolist()
    assert kept["bounds"] == jsonfile.plain(result["sara"]["bounds"]) and kept["blocks"] == result["sara"]["blocks"]


def test_the_record_alone_is_a_product_and_is_replaced(vis, tmp_path):
    record = tmp_path / "try.sara.json"
    record.write_text("old")
    with pytest.raises(FileExistsError, match="try.sara.json exist"):
        tsara(vis=vis, imagename=str(tmp_path / "try"), niter=0, **GRID)
    tsara(vis=vis, imagename=str(tmp_path / "try"), niter=5, overwrite=True, **GRID)
    assert json.loads(record.read_text())["history"]["iteration"] == [1, 2, 3, 4, 5]


def test_history_says_version_and_every_parameter(run):
    _, name, *_ = run
    ia = casatools.image()
    ia.open(name + ".model")
    history = "\n".join(ia.history(list=False))
    ia.close()
    assert "taskname=tsara" in history and "casa_sara" in history
    assert all(f"{word} " in history for word in ("vis", "imsize", "databound", "regscale", "nthreads"))


@pytest.mark.parametrize("factor", [2.0**10, 2.0**-20])  # exact in floating point: so is the image
def test_the_image_scales_with_the_data(run, copy, tmp_path, factor):
    edit(copy, "DATA", lambda data: data * factor)
    edit(copy, "WEIGHT", lambda weight: weight / factor**2)
    tsara(vis=str(copy), imagename=str(tmp_path / "scaled"), **GRID)
    model, scaled = pixels(run[1] + ".model"), pixels(str(tmp_path / "scaled.model"))
    np.testing.assert_allclose(scaled / factor, model, atol=1e-4 * model.max())


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_weights_are_found_out(copy, tmp_path, factor):
    edit(copy, "WEIGHT", lambda weight: weight / factor**2)  # the noise is 1/factor of what the weights say
    result = tsara(vis=str(copy), imagename=str(tmp_path / "wrong"), **GRID)
    for block in result["sara"]["blocks"]:
        assert block["noise_found"] == pytest.approx(1 / factor, rel=0.1)
    assert pixels(str(tmp_path / "wrong.model")).sum() == pytest.approx(FLUX, rel=0.03)


def test_noise_alone_gives_an_almost_empty_image_and_says_so(copy, tmp_path):
    rng = np.random.default_rng(0)
    edit(copy, "DATA", lambda data: 0.1 * (rng.normal(size=data.shape) + 1j * rng.normal(size=data.shape)))
    edit(copy, "WEIGHT", lambda weight: np.full_like(weight, 100.0))
    result = tsara(vis=str(copy), imagename=str(tmp_path / "noise"), **GRID)
    assert result["stopcode"] == NOISE_ONLY
    noise = result["sara"]["chosen"]["noise_jy_per_beam"]
    assert pixels(str(tmp_path / "noise.model")).max() < 4 * noise


@pytest.mark.parametrize("databound", ["weights", "fixed"])
def test_given_bounds_are_met(vis, tmp_path, databound):
    extra = dict(l2bound=[1.0]) if databound == "fixed" else {}
    result = tsara(vis=vis, imagename=str(tmp_path / "bounds"), databound=databound, **extra, **GRID)
    assert result["stopcode"] == CONVERGED
    for block in result["sara"]["blocks"]:
        degrees = 2 * block["samples"]
        assert block["l2_bound"] == pytest.approx(np.sqrt(degrees + 2 * np.sqrt(2 * degrees)))
        assert block["residual_norm"] < 1.02 * block["l2_bound"]


def test_niter_0_makes_dirty_images_and_a_limit_is_kept(vis, tmp_path):
    dirty = tsara(vis=vis, imagename=str(tmp_path / "dirty"), niter=0, **GRID)
    assert (dirty["iterdone"], dirty["stopcode"]) == (0, ITERATION_LIMIT)
    assert not pixels(str(tmp_path / "dirty.model")).any()
    assert pixels(str(tmp_path / "dirty.residual")).max() > 0.5
    few = tsara(vis=vis, imagename=str(tmp_path / "few"), niter=15, **GRID)
    assert (few["iterdone"], few["stopcode"]) == (15, ITERATION_LIMIT)


def test_existing_products_are_refused_replaced_or_continued(run, vis, tmp_path):
    name = str(tmp_path / "again")
    for product in PRODUCTS:
        shutil.copytree(f"{run[1]}.{product}", f"{name}.{product}")
    before = _hashes(tmp_path)
    with pytest.raises(FileExistsError, match="imagename.*overwrite = True.*restart = True"):
        tsara(vis=vis, imagename=name, **GRID)
    assert _hashes(tmp_path) == before
    continued = tsara(vis=vis, imagename=name, restart=True, niter=0, **GRID)
    assert continued["iterdone"] == 0
    np.testing.assert_array_equal(pixels(name + ".model"), pixels(run[1] + ".model"))
    tsara(vis=vis, imagename=name, overwrite=True, niter=0, **GRID)
    assert not pixels(name + ".model").any()


def test_a_failed_run_leaves_the_old_products(run, vis, tmp_path, monkeypatch):
    name = str(tmp_path / "old")
    for product in PRODUCTS:
        shutil.copytree(f"{run[1]}.{product}", f"{name}.{product}")
    before = _hashes(tmp_path)
    monkeypatch.setattr("casa_sara.imaging.plane_images.sum_of_weights", lambda *args: "not a number")
    with pytest.raises(ValueError, match="not a number"):
        tsara(vis=vis, imagename=name, overwrite=True, niter=0, **GRID)
    assert _hashes(tmp_path) == before


def test_start_model_is_used(run, vis, tmp_path):
    result = tsara(vis=vis, imagename=str(tmp_path / "warm"), startmodel=run[1] + ".model", niter=0, **GRID)
    assert result["summaryminor"][0][0][0]["modelFlux"][0] == pytest.approx(float(pixels(run[1] + ".model").sum()))
    assert np.abs(pixels(str(tmp_path / "warm.residual"))).max() == pytest.approx(
        np.abs(pixels(run[1] + ".residual")).max(), rel=1e-3)


def test_without_restoration_there_is_no_restored_image(vis, tmp_path):
    tsara(vis=vis, imagename=str(tmp_path / "plain"), niter=0, restoration=False, **GRID)
    assert not (tmp_path / "plain.image").exists() and (tmp_path / "plain.model").exists()


def test_the_model_column_holds_the_models_visibilities(copy, tmp_path):
    name = str(tmp_path / "self")
    result = tsara(vis=str(copy), imagename=name, savemodel="modelcolumn", **GRID)
    tb = casatools.table()
    tb.open(str(copy))
    model, data = tb.getcol("MODEL_DATA"), tb.getcol("DATA")
    tb.close()
    noise = result["sara"]["blocks"][0]["noise_found"] * 0.05
    assert np.std((data - model).real) == pytest.approx(noise, rel=0.1)
    np.testing.assert_array_equal(model[0], model[1])


def test_several_measurement_sets_and_odd_sizes(vis, copy, tmp_path):
    name = str(tmp_path / "both")
    result = tsara(vis=[vis, str(copy)], imagename=name, imsize=[121, 250], cell=["0.5arcsec", "0.25arcsec"],
                   datacolumn="data")
    assert pixels(name + ".model").shape == (121, 250)
    # the brighter point source: pixels 60 − l/cell, 125 + m/cell
    assert pixels(name + ".model")[80:89, 145:162].sum() == pytest.approx(1.0, rel=0.05)
    assert {block["ms"] for block in result["sara"]["blocks"]} == {vis, str(copy)}


def test_ctrl_c_ends_with_the_best_image_so_far(vis, tmp_path, monkeypatch):
    import os
    import signal

    from casa_sara.casa.runtime import log

    class Interrupting(log.Progress):
        def __call__(self, iteration, message, fraction=None):
            if iteration == 12:
                os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(log, "Progress", Interrupting)
    result = tsara(vis=vis, imagename=str(tmp_path / "stopped"), **GRID)
    assert (result["stopcode"], result["iterdone"]) == (STOPPED_BY_USER, 12)
    assert pixels(str(tmp_path / "stopped.model")).sum() > 0.5


def test_coarse_cells_and_large_w_are_pointed_out(vis, tmp_path):
    result = tsara(vis=vis, imagename=str(tmp_path / "coarse"), niter=0, imsize=2000, cell="1arcsec", datacolumn="data")
    assert any("cell = '1arcsec'" in note and "5 would be" in note for note in result["sara"]["notes"])
    assert any("w-term" in note for note in result["sara"]["notes"])
    fine = tsara(vis=vis, imagename=str(tmp_path / "fine"), niter=0, **GRID)
    assert fine["sara"]["notes"] == []


def test_corrected_column_absent_is_said_loudly(vis, tmp_path):
    result = tsara(vis=vis, imagename=str(tmp_path / "data"), niter=0, imsize=128, cell="0.5arcsec")
    assert any("CORRECTED_DATA" in note and "DATA is imaged" in note for note in result["sara"]["notes"])


@pytest.mark.parametrize("parameters, message", [
    (dict(vis="absent.ms"), "vis"),
    (dict(vis=""), "vis"),
    (dict(field="NOWHERE"), "field"),
    (dict(spw="7"), "spw"),
    (dict(antenna="Z99"), "antenna"),
    (dict(timerange="2031/01/01/00:00:00~2031/01/01/01:00:00"), "timerange"),
    (dict(uvrange=">90000klambda"), "uvrange"),
    (dict(cell="30arcsec"), "cell.*30"),
    (dict(cell="-1arcsec"), "cell"),
    (dict(cell="fast"), "cell"),
    (dict(cell=[]), "cell"),
    (dict(imsize=[64, 64, 2]), "imsize"),
    (dict(imsize=0), "imsize"),
    (dict(stokes="Q"), "stokes"),
    (dict(imagename="absent_folder/image"), "imagename.*absent_folder"),
    (dict(imagename=""), "imagename"),
    (dict(databound="fixed"), "l2bound"),
    (dict(databound="fixed", l2bound=[-1.0]), "l2bound"),
    (dict(databound="fixed", l2bound=[1.0, 2.0, 3.0]), "l2bound"),
    (dict(startmodel="absent.model"), "startmodel"),
    (dict(parallel=True), "parallel.*mpirun"),
    (dict(blocks=-1), "blocks"),
    (dict(blocks=10**8), "blocks"),
    (dict(wavelets=["db9"]), "wavelets"),
    (dict(wavelets=[]), "wavelets"),
    (dict(regscale=-1.0), "regscale"),
    (dict(regscale=0.0), "regscale"),
    (dict(restoringbeam="fat"), "restoringbeam"),
    (dict(weighting="briggs", uvtaper=["x"]), "uvtaper"),
])
def test_bad_parameters_raise_and_name_themselves(vis, tmp_path, parameters, message):
    values = dict(vis=vis, imagename=str(tmp_path / "bad"), niter=10, **GRID) | parameters
    with pytest.raises((ValueError, FileNotFoundError, OSError), match=message):
        tsara(**values)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("column, change, message", [
    ("FLAG", lambda flag: flag | True, "flagged"),
    ("WEIGHT", lambda weight: 0 * weight, "weight"),
    ("DATA", lambda data: data * np.nan, "finite"),
])
def test_nothing_left_to_image_raises(copy, tmp_path, column, change, message):
    edit(copy, column, change)
    with pytest.raises(ValueError, match=message):
        tsara(vis=str(copy), imagename=str(tmp_path / "none"), **GRID)
    assert [path.name for path in tmp_path.iterdir()] == ["copy.ms"]


def test_bad_samples_are_dropped_and_counted(copy, tmp_path):
    def spoil(data):
        data[0, 0, 5] = np.nan
        data[1, 1, 6] = np.inf
        return data

    edit(copy, "DATA", spoil)
    edit(copy, "WEIGHT", lambda weight: np.where(np.arange(weight.shape[1]) == 9, -1.0, weight))
    result = tsara(vis=str(copy), imagename=str(tmp_path / "some"), niter=10, **GRID)
    assert sum(result["sara"]["dropped"].values()) == 2 + 3  # two samples, and a row of three channels
    assert np.isfinite(pixels(str(tmp_path / "some.image"))).all()


def test_wild_samples_are_left_out_named_and_counted(run, vis, copy, tmp_path):
    """Two samples of 10⁴ Jy on a source of 1.9 Jy: the model is that of the data without them."""
    flagged = shutil.copytree(vis, tmp_path / "flagged.ms")
    for name, spoilt, column in [(copy, 1e4, "DATA"), (flagged, True, "FLAG")]:
        def spoil(values):
            values[:, 0, [10, 300]] = spoilt
            return values

        edit(name, column, spoil)
    some = GRID | dict(niter=85)  # until the support, and what may be negative, are found by thresholds
    tsara(vis=str(flagged), imagename=str(tmp_path / "flagged"), **some)
    result = tsara(vis=str(copy), imagename=str(tmp_path / "wild"), **some)
    sara = result["sara"]
    assert sara["dropped"]["wild"] == len(sara["wild"]) == 2
    assert sorted(sample["row"] for sample in sara["wild"]) == [10, 300]
    assert all(sample["amplitude_jy"] == pytest.approx(1e4, rel=1e-3) for sample in sara["wild"])
    assert {"antenna1", "antenna2", "time_mjd_s", "ms"} <= set(sara["wild"][0])
    model, clean = pixels(str(tmp_path / "wild.model")), pixels(str(tmp_path / "flagged.model"))
    assert np.linalg.norm(model - clean) < 1e-3 * np.linalg.norm(clean)
    residual, wanted = (pixels(str(tmp_path / f"{name}.residual")) for name in ("wild", "flagged"))
    assert residual.std() < 1.01 * wanted.std()
    assert sum(block["samples"]
               for block in sara["blocks"]) == run[0]["sara"]["visibilities"] - 2 == sara["visibilities"]


def test_a_report_of_the_run(vis, tmp_path):
    name = tmp_path / "run"
    tsara(vis=vis, imagename=str(name), report=True, niter=40, **GRID)
    page = (tmp_path / "run.report" / "report.html").read_text()
    assert all(words in page for words in ("natural weighting", "briggs weighting", "Convergence", "c.ms"))
    with pytest.raises(FileExistsError, match="run.report"):
        tsara(vis=vis, imagename=str(name), report=True, niter=40, **GRID)
    (tmp_path / "run.report" / "mine.txt").write_text("mine")
    tsara(vis=vis, imagename=str(name), niter=20, overwrite=True, **GRID)
    assert [path.name for path in (tmp_path / "run.report").iterdir()] == ["mine.txt"]  # the report was of older images
