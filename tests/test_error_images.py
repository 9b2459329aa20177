"""tsara with ndraws: images of errors, what is kept of the draws, refusals, an end in the middle, and the forecast."""

import contextlib
import os
import re
import shutil
from unittest import mock

import numpy as np
import pytest
from simulated_ms import column, edit, pixels, simulate

pytest.importorskip("casatools")

from casa_sara import saracompare, tsara
from casa_sara.casa.runtime import log
from casa_sara.imaging import run_solver
from casa_sara.reconstruction.bootstrap import DRAW_ITERATIONS
from casa_sara.reconstruction.draws import Draws
from casa_sara.solver.record import CONVERGED

ARCSEC = np.pi / 180 / 3600
SKY = [(1.0, -12 * ARCSEC, 7 * ARCSEC), (0.4, 9 * ARCSEC, -10 * ARCSEC), (0.3, 1 * ARCSEC, 1.5 * ARCSEC)]
NDRAWS = 4
COMMON = dict(imsize=72, cell="0.9arcsec", datacolumn="data", nthreads=1)
EXTRA = (".model.error", ".image.error", ".draws.npz")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("errors")


@pytest.fixture(scope="module")
def vis(folder):
    return str(simulate(folder / "c.ms", configuration="c", antennas=14, sky=SKY, noise=0.2, scans=4, integration=20.0,
                        spacing_seconds=5400.0, hour_angle=-2.5, seed=4))


def image(vis, name, **changes):
    """Run the task; return what it returns and its log lines."""
    lines = []
    with mock.patch.object(log, "_post", lambda message, level: lines.append(f"{level} {message}")):
        return tsara(vis=vis, imagename=str(name), **COMMON | dict(ndraws=NDRAWS) | changes), lines


@pytest.fixture(scope="module")
def whole(vis, folder):
    return image(vis, folder / "whole")


def kept_draws(name):
    with np.load(f"{name}.draws.npz", allow_pickle=False) as arrays:
        return Draws.of(dict(arrays))


def header(name):
    from casatools import image as tool

    ia = tool()
    ia.open(str(name))
    try:
        return ia.brightnessunit(), ia.restoringbeam(), list(ia.maskhandler("get")), ia.history(list=False)
    finally:
        ia.close()


def smoothed_by_casa(model, like, name, beam):
    """A model in Jy/pixel smoothed by CASA, in Jy/beam."""
    from casatools import image as tool

    ia = tool()
    made = ia.newimagefromimage(infile=str(like), outfile=str(name), overwrite=True)
    made.putchunk(model[:, :, None, None])
    made.setbrightnessunit("Jy/pixel")
    smooth = made.convolve2d(type="gaussian", major=beam["major"], minor=beam["minor"], pa=beam["positionangle"])
    found = smooth.getchunk()[:, :, 0, 0]
    smooth.close()
    made.close()
    return found


def test_errors_are_images_beside_the_others(whole, folder, vis):
    result, lines = whole
    name = folder / "whole"
    draws = kept_draws(name)
    assert len(draws) == NDRAWS and draws.complete and result["sara"]["draws"] == dict(asked=NDRAWS, made=NDRAWS)
    assert result["stopcode"] == CONVERGED and not os.path.exists(f"{name}.checkpoint")
    error = pixels(f"{name}.model.error")
    np.testing.assert_allclose(error, draws.error(), rtol=1e-6)
    unit, beam, _, history = header(f"{name}.model.error")
    assert unit == "Jy/pixel" and beam == {} and any("ndraws" in line for line in history)
    unit, beam, masks, _ = header(f"{name}.image.error")
    assert unit == "Jy/beam" and beam == header(f"{name}.image")[1] and masks == header(f"{name}.image")[2]
    differences = [smoothed_by_casa(difference, f"{name}.model", folder / "scratch", beam)
                   for difference in draws.differences()]
    expected = np.sqrt(np.mean(np.square(differences), axis=0))
    assert np.abs(pixels(f"{name}.image.error") - expected).max() < 2e-3 * expected.max()


def test_the_errors_have_the_size_of_the_noise_and_of_what_is_wrong(whole, folder):
    noise = whole[0]["sara"]["chosen"]["noise_jy_per_beam"]
    error, restored = pixels(folder / "whole.image.error"), pixels(folder / "whole.image")
    peak = np.unravel_index(restored.argmax(), restored.shape)
    assert 0.3 * noise < error[peak] < 3 * noise
    islands = sorted(whole[0]["sara"]["islands"], key=lambda island: -island["flux_jy"])
    for island, (flux, _, _) in zip(islands, SKY, strict=False):
        assert 0.2 * noise < island["bootstrap_error_jy"] < 6 * noise  # of four draws
        assert abs(island["flux_jy"] - flux) < 4 * island["bootstrap_error_jy"] + noise


def test_the_log_tells_of_the_draws_and_of_the_errors_of_fluxes(whole):
    result, lines = whole
    drawn = [line for line in lines if "bootstrap: draw" in line]
    assert [re.search(r"draw (\d+) of 4", line)[1] for line in drawn] == ["0", "1", "2", "3", "4"]
    assert "left" in drawn[1] and any("errors of the model follow from 4 draws" in line for line in lines)
    first = result["sara"]["islands"][0]
    assert any(f"{first['flux_jy']:.4g} +- {first['bootstrap_error_jy']:.2g} Jy" in line for line in lines)


@pytest.fixture(scope="module")
def plain(vis, folder):
    return image(vis, folder / "plain", ndraws=0)[0]


def test_the_image_is_that_without_draws(whole, plain, folder):
    np.testing.assert_array_equal(pixels(folder / "plain.model"), pixels(folder / "whole.model"))
    assert "draws" not in plain["sara"] and "bootstrap_error_jy" not in plain["sara"]["islands"][0]
    assert not any(os.path.exists(f"{folder / 'plain'}{suffix}") for suffix in EXTRA)


def interrupted(vis, name, iterations, **changes):
    """Run, as if Ctrl-C was pressed after so many iterations of draws."""
    drawing = run_solver._Drawing
    begun, done = [], []

    class Counted(drawing):
        def __call__(self, name, draws):
            begun.append(1)
            super().__call__(name, draws)

    @contextlib.contextmanager
    def pressed_late():
        def pressed():
            done.extend(begun[:1])
            return len(done) >= iterations
        yield pressed

    with mock.patch.multiple(run_solver, _Drawing=Counted, stop_on_interrupt=pressed_late):
        return image(vis, name, **changes)


def test_an_end_in_the_middle_of_the_draws_keeps_those_made_and_a_restart_makes_the_others(vis, whole, folder):
    name = folder / "stopped"
    result, lines = interrupted(vis, name, 2 * DRAW_ITERATIONS + 33)
    assert result["sara"]["draws"] == dict(asked=NDRAWS, made=2) and result["stopcode"] == CONVERGED
    go_on = f"restart = True makes the others, from '{name}.checkpoint'"
    assert any(line.startswith("WARN 2 of 4 draws were made") and go_on in line for line in lines)
    np.testing.assert_allclose(pixels(f"{name}.model.error"), kept_draws(name).error(), rtol=1e-6)
    result, _ = image(vis, name, restart=True)
    assert result["sara"]["draws"] == dict(asked=NDRAWS, made=NDRAWS) and not os.path.exists(f"{name}.checkpoint")
    for suffix in (".model", ".model.error", ".image.error"):
        np.testing.assert_array_equal(pixels(f"{name}{suffix}"), pixels(f"{folder / 'whole'}{suffix}"))
    assert [island["bootstrap_error_jy"] for island in result["sara"]["islands"]] \
        == [island["bootstrap_error_jy"] for island in whole[0]["sara"]["islands"]]


def test_one_draw_is_too_few_for_an_error(vis, folder):
    name = folder / "early"
    result, lines = interrupted(vis, name, DRAW_ITERATIONS + 1)
    assert result["sara"]["draws"]["made"] == 1 and any("no errors follow from so few" in line for line in lines)
    assert os.path.exists(f"{name}.checkpoint") and not any(os.path.exists(f"{name}{suffix}") for suffix in EXTRA)
    image(vis, name, ndraws=0, overwrite=True)  # an image without errors leaves none of those before


def test_new_images_without_errors_remove_the_old_ones(vis, folder):
    name = folder / "again"
    image(vis, name, ndraws=2)
    assert all(os.path.exists(f"{name}{suffix}") for suffix in EXTRA)
    image(vis, name, ndraws=0, overwrite=True)
    assert not any(os.path.exists(f"{name}{suffix}") for suffix in EXTRA)


def test_a_restoring_beam_that_is_asked_for_is_that_of_the_errors(vis, folder):
    name = folder / "beam"
    image(vis, name, ndraws=2, restoringbeam=["12arcsec", "9arcsec", "30deg"])
    beam = header(f"{name}.image.error")[1]
    assert beam["major"]["value"] == 12 and beam["minor"]["value"] == 9 and beam["positionangle"]["value"] == 30
    expected = np.sqrt(np.mean([smoothed_by_casa(difference, f"{name}.model", folder / "scratch", beam) ** 2
                                for difference in kept_draws(name).differences()], axis=0))
    assert np.abs(pixels(f"{name}.image.error") - expected).max() < 2e-3 * expected.max()
    image(vis, name, ndraws=2, restoration=False, overwrite=True)
    assert os.path.exists(f"{name}.model.error") and not os.path.exists(f"{name}.image.error")


@pytest.mark.parametrize("changes", [
    dict(significance=0.0), dict(databound="weights"), dict(databound="fixed", l2bound=[1.1]), dict(positivity=False),
    dict(stokes="V", positivity=False), dict(nreweights=0), dict(niter=60), dict(spectralindex=-0.7),
    dict(gridder="wproject"), dict(mask="circle[[49pix,44pix],9pix]"),
], ids=str)
def test_errors_of_every_kind_of_solution(vis, folder, changes):
    """A few times the noise at the peak of the model; where there is no model, as in Stokes V, no errors."""
    result, lines = image(vis, folder / "kind", ndraws=3, overwrite=True, **changes)
    model = pixels(folder / "kind.model")
    if "stokes" in changes:
        assert not model.any() and any("no draws: the model is empty" in line for line in lines)
        assert not os.path.exists(f"{folder / 'kind'}.model.error")
        return
    error = pixels(folder / "kind.image.error")
    assert np.isfinite(error).all() and (error >= 0).all()
    peak = np.unravel_index(model.argmax(), model.shape)
    assert 0.3 < error[peak] / result["sara"]["chosen"]["noise_jy_per_beam"] < 8
    if "mask" in changes:
        x, y = np.indices(model.shape)
        assert not pixels(folder / "kind.model.error")[np.hypot(x - 49, y - 44) > 9.5].any()


@pytest.mark.parametrize("changes", [dict(ndraws=1), dict(niter=0), dict(method="dabbech2018")])
def test_what_has_no_errors_is_refused(vis, folder, changes):
    with pytest.raises(ValueError, match=f"ndraws = {changes.get('ndraws', NDRAWS)}"):
        image(vis, folder / "refused", **changes)
    if "ndraws" not in changes:
        with pytest.raises(ValueError, match="jackknife = True"):
            image(vis, folder / "refused", **changes | dict(ndraws=0, jackknife=True))
    assert not list(folder.glob("refused*"))


def test_a_jackknife_is_an_image_and_an_error_of_islands(vis, folder):
    name = folder / "jack"
    result, lines = image(vis, name, jackknife=True, ndraws=2)
    assert result["sara"]["jackknife"] == dict(groups=4, made=4)
    assert any("jackknife: group 4 of 4" in line for line in lines)
    unit, beam, masks, _ = header(f"{name}.image.jackknife")
    assert unit == "Jy/beam" and (beam, masks) == header(f"{name}.image")[1:3]
    island = result["sara"]["islands"][0]
    assert 0 < island["jackknife_error_jy"] < 0.1 and island["bootstrap_error_jy"] > 0
    assert any("by the jackknife over snapshots are" in line for line in lines)
    np.testing.assert_array_equal(pixels(f"{name}.model"), pixels(folder / "whole.model"))
    image(vis, name, ndraws=0, overwrite=True)
    assert not os.path.exists(f"{name}.image.jackknife")
    with pytest.raises(ValueError, match="jackknife = True: there are 2 blocks"):
        image(vis, folder / "refused", jackknife=True, blocks=2)


def test_gain_errors_show_in_the_jackknife_and_little_in_the_draws(folder):
    """A bright source whose amplitude is wrong by 10 % in each scan."""
    sky = [(1.0, 2 * ARCSEC, 1 * ARCSEC)]
    name = str(simulate(folder / "gains.ms", configuration="c", antennas=14, sky=sky, noise=0.05, scans=8,
                        integration=20.0, spacing_seconds=2700.0, hour_angle=-2.5, seed=4))
    scans = column(name, "SCAN_NUMBER")
    gains = 1 + 0.1 * np.random.default_rng(3).standard_normal(scans.max() + 1)
    edit(name, "DATA", lambda data: data * gains[scans])
    result, lines = image(name, folder / "gains", jackknife=True, ndraws=5)
    island = result["sara"]["islands"][0]
    assert island["jackknife_error_jy"] > 2 * island["bootstrap_error_jy"]
    assert 0.3 * 0.1 / np.sqrt(8) < island["jackknife_error_jy"] < 2 * 0.1 / np.sqrt(8)
    assert any(line.startswith("WARN errors of the fluxes of islands by the jackknife") for line in lines)


def test_a_dry_run_tells_what_the_draws_take(vis, folder):
    found, lines = image(vis, folder / "dry", dryrun=True)
    without, _ = image(vis, folder / "dry", dryrun=True, ndraws=0)
    seconds = found["forecast"]["seconds"]
    assert seconds["drawing"] == pytest.approx(NDRAWS * (DRAW_ITERATIONS + 8) * seconds["iteration"])
    assert any("4 draws for the errors" in line for line in lines) and without["forecast"]["seconds"]["drawing"] == 0
    memory = [one["forecast"]["memory_bytes"] for one in (found, without)]
    assert "draws" in memory[0]["drawing"] and "drawing" not in memory[1]
    assert memory[0]["drawing"]["draws"] == int(4 * (1.5 * 4 * 0.3) * 72**2) + 4 * 2 * 72**2


# regions of saracompare

REGION = "19h59m27.44s +40d44m09s 6arcsec"


def region_of(vis, *names):
    models, regions = [str(name) for name in names], [f"east = {REGION}"]
    measures = saracompare(models=models, vis=vis, datacolumn="data", regions=regions)
    return measures["products"]


def flux_errors_by_hand(name, inside):
    return np.sqrt(np.mean([difference[inside].sum() ** 2 for difference in kept_draws(name).differences()]))


def test_a_region_has_the_error_of_the_sum_of_its_pixels(whole, vis, folder):
    image(vis, folder / "coarse", ndraws=0, cell="1.1arcsec")
    found = region_of(vis, folder / "whole", folder / "coarse")
    nx = np.indices((72, 72))
    inside = np.hypot(nx[0] - (36 + 12.04 / 0.9), nx[1] - (36 + 7 / 0.9)) <= 6 / 0.9  # the region's centre in pixels
    east = found["whole"]["regions"]["east"]
    assert east["model_flux_jy"] == pytest.approx(pixels(folder / "whole.model")[inside].sum(), rel=1e-3)
    assert east["model_error_jy"] == pytest.approx(flux_errors_by_hand(folder / "whole", inside), rel=0.05)
    assert "model_error_jy" not in found["coarse"]["regions"]["east"]


def test_on_other_pixels_the_error_is_nearly_the_same(whole, vis, folder):
    image(vis, folder / "coarse", ndraws=0, cell="1.1arcsec", overwrite=True)
    errors = [region_of(vis, *order)["whole"]["regions"]["east"]["model_error_jy"]
              for order in ((folder / "whole", folder / "coarse"), (folder / "coarse", folder / "whole"))]
    assert errors[1] == pytest.approx(errors[0], rel=0.1)


def test_draws_of_another_image_and_damaged_ones_are_refused(vis, folder):
    for name in ("one", "other"):
        image(vis, folder / name, ndraws=2, **dict(imsize=80) if name == "other" else {})
    shutil.copy(f"{folder / 'other'}.draws.npz", f"{folder / 'one'}.draws.npz")
    with pytest.raises(ValueError, match=r"one.draws.npz' is of an image of 80 x 80 pixels, .*72 x 72"):
        region_of(vis, folder / "one", folder / "other")
    os.unlink(f"{folder / 'one'}.draws.npz")
    arrays = kept_draws(folder / "other").arrays()
    for change in (dict(pixels=arrays["pixels"] + 6400), dict(values=arrays["values"][1:]),
                   dict(counts=arrays["counts"] * 3)):
        np.savez(f"{folder / 'other'}.draws.npz", **arrays | change)
        with pytest.raises(ValueError, match="models: '.*other.draws.npz' cannot be read as the draws of a model"):
            region_of(vis, folder / "other", folder / "one")
    for content in (b"", b"PK nothing"):
        with open(f"{folder / 'other'}.draws.npz", "wb") as file:
            file.write(content)
        with pytest.raises(ValueError, match="models: '.*other.draws.npz' cannot be read"):
            region_of(vis, folder / "other", folder / "one")


# features of saracompare

@pytest.mark.slow
def test_a_source_is_real_and_nothing_is_not(whole, plain, vis, folder):
    features = ["third = 19h59m28.588s +40d44m03.5s 3arcsec", "nothing = 19h59m28.1s +40d43m48s 3arcsec"]
    models, noise = [str(folder / "whole"), str(folder / "plain")], whole[0]["sara"]["chosen"]["noise_jy_per_beam"]
    found = saracompare(models=models, vis=vis, datacolumn="data", features=features,
                        outdir=str(folder / "compared"), overwrite=True)["products"]
    for name in ("whole", "plain"):  # the same run, with draws and without
        real, nothing = (found[name]["features"][feature] for feature in ("third", "nothing"))
        assert real["flux_jy"] == pytest.approx(0.3, abs=0.03) and real["sigma"] > 10 and len(real["drawn"]) == 20
        assert real["delta_chi_square"] == pytest.approx((0.3 / noise) ** 2, rel=0.2)
        assert nothing["p_value"] > 1e-3 and nothing["delta_chi_square"] < 30
    page = (folder / "compared" / "report.html").read_text()
    assert "Is it real?" in page and "whole, third" in page and "Errors, natural beam" in page
    for name in ("errors_natural.png", "errors_briggs.png", "features.png"):
        assert (folder / "compared" / name).stat().st_size > 20_000
