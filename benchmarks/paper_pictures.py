"""The pictures of the paper's experiments: models and residuals, the core over cell sizes, and convergence."""

from __future__ import annotations

import numpy as np
from paper_sky import APERTURE, MASTER_CELL

from casa_sara.analysis.metrics import smooth
from casa_sara.demo.sky import COMPANION_JY, COMPANION_OFFSET

__all__ = ["convergence_picture", "core_picture", "picture"]


def picture(path, name, truth, found, images, cell):
    """Models and residuals of the three imagers beside the truth."""
    from casa_sara.analysis.plots import Column, Zoom, compare

    beam = images["tsara"][2]
    shape = found["tsara"].shape
    area = np.pi * beam[0] * beam[1] / (4 * np.log(2)) / cell**2
    smoothed = area * truth.on(shape, cell, beam[:2], beam[2])
    columns = [Column("truth", truth.on(shape, cell, (cell, cell)), smoothed, None, beam, "truth",
                      f"{name} band, VLA A+B+C+D")]
    for key, label in (("tsara", "tsara"), ("clean_briggs", "tclean Briggs −1"), ("clean_natural", "tclean natural")):
        restored, residual, beam = images[key]
        columns.append(Column(label, found[key], restored, residual, beam, f"model, {found[key].sum():.2f} Jy"))
    zooms = [Zoom("core and neighbour", -0.15, -0.1, 1.8), Zoom("western hotspots", -11.0, 3.3, 3.0)]
    compare(path, columns, cell, zooms, title=f"{name} band at {cell} arcsec")


def core_picture(path, name, truth, models, found, cell):
    """The core over cell sizes: brightness of the truth, of tsara's models, and of tclean's natural one."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [("truth at 0.1\"", smooth(truth.image, 0.1 / MASTER_CELL), MASTER_CELL)]
    shown += [(f"tsara, {size}\"", model, size) for size, model in models.items()]
    shown += [(f"tclean {key}, {cell}\"", found[f"clean_{key}"], cell) for key in ("briggs", "natural")]
    figure, axes = plt.subplots(1, len(shown), figsize=(3 * len(shown), 3.4), constrained_layout=True)
    top = np.log10(shown[0][1].max() / MASTER_CELL**2)
    for axis, (title, image, size) in zip(axes, shown):
        nx, ny = image.shape
        extent = np.array([nx // 2 + 0.5, nx // 2 + 0.5 - nx, -(ny // 2) - 0.5, ny - ny // 2 - 0.5]) * size
        drawn = axis.imshow(np.log10(np.maximum(image / size**2, 10 ** (top - 4))).T, origin="lower", extent=extent,
                            cmap="inferno", vmin=top - 3.5, vmax=top, interpolation="nearest")
        axis.add_patch(plt.Circle(COMPANION_OFFSET, APERTURE, fill=False, color="lime"))
        axis.set(xlim=(0.75, -1.05), ylim=(-1.0, 0.8), title=title, xlabel="east [arcsec]")
    figure.colorbar(drawn, ax=axes, label="log10 Jy arcsec$^{-2}$")
    figure.suptitle(f"{name} band: the core and its neighbour of {1e3 * COMPANION_JY:.0f} mJy (circle)")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def convergence_picture(path, reached):
    """SNR over iterations of each variant, arrays (n, 2) by name."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4.5), constrained_layout=True)
    for name, curve in reached.items():
        axis.plot(*curve.T, label=name)
    axis.set(xlabel="iteration", ylabel="SNR of the model at 0.1 arcsec [dB]", xscale="log")
    axis.legend()
    axis.grid(alpha=0.3)
    figure.savefig(path, dpi=100)
    plt.close(figure)
