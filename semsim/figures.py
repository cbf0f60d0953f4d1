"""A contact sheet of a tilt series: images, heights, and what the reference view sees of each."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError
from semsim.mesh import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from semsim.truth import GroundTruth

COLUMNS = 5
"""Most views side by side; more are shared evenly among blocks."""
PANEL_INCHES, DPI = 3.4, 140
MISS, HIDDEN = "#c8c8c8", (0.90, 0.35, 0.10)
"""Colours: nothing under the beam; surface that the reference view does not see."""


@dataclass(frozen=True, eq=False)
class Series:
    """What a series folder shows everybody.

    Parameters
    ----------
    images
        Per view, grey levels (rows, columns).
    tilts_deg, names
        Per view.
    pixel_size_um
        NaN where the folder does not say.
    """

    images: tuple[NDArray[Any], ...]
    tilts_deg: tuple[float, ...]
    names: tuple[str, ...]
    pixel_size_um: float

    @property
    def reference(self) -> int:
        """The view nearest zero tilt."""
        return int(np.argmin(np.abs(self.tilts_deg)))


def read_series(series_dir: Path) -> Series:
    """Read images and tilts of a tilt-series folder.

    Raises
    ------
    InputError
        The folder has no series.toml, or it or an image cannot be read.
    """
    path = series_dir / "series.toml"
    if not path.is_file():
        raise InputError(f"{series_dir} is not a tilt series (it has no series.toml); give a folder that render wrote")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        views = [(str(view["image"]), float(view["tilt_deg"])) for view in table["view"]]
        size_um = float(table.get("pixel_size_um", np.nan))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is no tilt series; each [[view]] needs image and tilt_deg ({error})") from None
    if not views:
        raise InputError(f"{path} names no view; a tilt series needs one or more")
    images = tuple(_grey(series_dir / name) for name, _ in views)
    return Series(images, tuple(tilt for _, tilt in views), tuple(name for name, _ in views), size_um)


def write_contact_sheet(series_dir: str | Path, out: str | Path) -> Path:
    """Draw every view of a series; with truth/ also its heights, and what the reference view sees of it.

    Parameters
    ----------
    series_dir
        A tilt-series folder, simulated or real.
    out
        Picture to be written: .png, .jpg, .pdf or .svg.

    Raises
    ------
    InputError
        The folder is no series, its truth cannot be read, or the picture cannot be written there.
    """
    from semsim.io import read_truth

    picture = Path(out)
    require_picture(picture)
    series = read_series(Path(series_dir))
    truth = read_truth(series_dir) if (Path(series_dir) / "truth").is_dir() else None
    if truth is not None:
        series = _without_data_bar(series, truth.microscope.height_px)
    figure = _sheet(series, truth, f"{Path(series_dir).resolve().name}: {_described(series)}")
    partial = picture.with_name(f".{picture.stem}.partial{picture.suffix}")
    figure.savefig(partial, dpi=DPI)
    return partial.replace(picture)


def require_picture(path: Path) -> None:
    """Raise InputError unless a picture can be written to a path."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".pdf", ".svg"):
        raise InputError(f"{path} is no picture; give a file that ends in .png, .jpg, .pdf or .svg")
    if not path.absolute().parent.is_dir() or path.is_dir():
        raise InputError(f"{path} cannot be written; give a file in a folder that exists")


def _grey(path: Path) -> NDArray[Any]:
    """Read an image as grey levels (rows, columns)."""
    from PIL import Image

    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            import tifffile

            image = tifffile.imread(path)
        else:
            with Image.open(path) as opened:
                image = np.asarray(opened.convert("L") if opened.mode not in ("I;16", "I", "F") else opened)
    except Exception as error:  # whatever a reader of some format raises, the file is what is wrong
        raise InputError(f"{path} cannot be read as an image: {error}") from error
    return np.asarray(image if image.ndim == 2 else image[..., :3].mean(axis=-1))


def _without_data_bar(series: Series, rows: int) -> Series:
    """Return a series with the rows that show the specimen, which are those of the truth."""
    return replace(series, images=tuple(image[:rows] for image in series.images))


def _described(series: Series) -> str:
    rows, columns = series.images[0].shape
    size = "" if np.isnan(series.pixel_size_um) else f", {1000 * series.pixel_size_um:.4g} nm a pixel"
    return f"{len(series.images)} views of {columns} x {rows} px{size}"


def _sheet(series: Series, truth: GroundTruth | None, title: str) -> Figure:
    """Lay out blocks of a few views; within a block a row of images, and with truth of heights and visibility."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    views = len(series.images)
    columns, kinds = -(-views // -(-views // COLUMNS)), 1 if truth is None else 3
    rows = -(-views // columns) * kinds
    shape = series.images[0].shape
    height = PANEL_INCHES * min(max(shape[0] / shape[1], 0.3), 2.0)
    figure = Figure(figsize=(PANEL_INCHES * columns + 1.0, (height + 0.3) * rows + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for each in axes.ravel():
        each.set_axis_off()
    for view in range(views):
        block, column = divmod(view, columns)
        _draw_image(axes[block * kinds, column], series, view)
    if truth is not None:
        _draw_truth(figure, axes.reshape(-1, kinds, columns), series, truth)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    return figure


def _draw_truth(figure: Figure, axes: NDArray[Any], series: Series, truth: GroundTruth) -> None:
    """Draw heights and visibility of every view; axes are (blocks, kinds, columns)."""
    step = _step(truth.microscope.shape)
    heights = [truth.height_map(view)[::step, ::step] for view in range(len(truth))]
    finite = np.concatenate([each[np.isfinite(each)] for each in heights])
    low, high = np.quantile(finite, [0.002, 0.998]) if finite.size else (0.0, 1.0)
    for view, z_um in enumerate(heights):
        block, column = divmod(view, axes.shape[2])
        panel = axes[block, 1, column]
        shown = panel.imshow(z_um, cmap="viridis", vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
        _finish(panel, "height, along the beam", z_um.shape, series.pixel_size_um * step)
        _draw_visibility(axes[block, 2, column], series, truth, view, step)
        if column == axes.shape[2] - 1 or view == len(heights) - 1:
            figure.colorbar(shown, ax=list(axes[block, 1]), label="height, µm", extend="both", shrink=0.9, pad=0.01)


def _draw_visibility(axes: Axes, series: Series, truth: GroundTruth, view: int, step: int) -> None:
    """Draw the image, coloured where the reference view does not see what this view sees."""
    buffer = truth.buffers[view]
    surface = ~buffer.miss[::step, ::step]
    seen = surface if view == series.reference else truth.visible(series.reference, buffer.position_um[::step, ::step])
    grey = _stretched(series.images[view])[::step, ::step]
    picture = 0.35 + 0.65 * np.repeat(grey[..., None], 3, axis=-1)
    picture[~seen] = 0.35 * picture[~seen] + 0.65 * np.array(HIDDEN)
    picture[~surface] = 1.0
    axes.imshow(picture, interpolation="nearest")
    share = seen.sum() / max(surface.sum(), 1)
    name = Path(series.names[series.reference]).stem
    what = "the reference view" if view == series.reference else f"{share:.1%} seen from {name}, the rest orange"
    _finish(axes, what, surface.shape, series.pixel_size_um * step)


def _draw_image(axes: Axes, series: Series, view: int) -> None:
    image = series.images[view]
    step = _step(image.shape)
    reduced = _averaged(_stretched(image), step)
    axes.imshow(reduced, cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    title = f"{Path(series.names[view]).stem}, tilt {series.tilts_deg[view]:g}°"
    _finish(axes, title, reduced.shape, series.pixel_size_um * step)


def _step(shape: tuple[int, ...]) -> int:
    """Every how many pixels a panel needs."""
    return max(1, int(shape[1] / (PANEL_INCHES * DPI)))


def _averaged(image: Array, step: int) -> Array:
    """Average blocks of `step` x `step` pixels, which leaves grey noise as the eye would see it from afar."""
    rows, columns = (size // step * step for size in image.shape)
    return np.asarray(image[:rows, :columns].reshape(rows // step, step, columns // step, step).mean(axis=(1, 3)))


def _stretched(image: NDArray[Any]) -> Array:
    """Grey levels from 0 to 1; only 16 bit images, which few use to the full, are stretched."""
    if image.dtype == np.uint8:
        return image / 255.0
    low, high = np.quantile(image, [0.001, 0.999])
    return np.asarray(np.clip((image - low) / max(high - low, 1e-9), 0.0, 1.0))


def _finish(axes: Axes, title: str, shape: tuple[int, ...], pixel_size_um: float) -> None:
    axes.set_axis_on()
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor(MISS)
    if np.isfinite(pixel_size_um):
        _scale_bar(axes, shape, pixel_size_um)


def _scale_bar(axes: Axes, shape: tuple[int, ...], pixel_size_um: float) -> None:
    """Draw a bar of a round length, at most a quarter of the width, in the lower left corner."""
    length_um = round_length(shape[1] * pixel_size_um / 4)
    x, y = 0.04 * shape[1], 0.94 * shape[0]
    for colour, width in (("black", 5), ("white", 3)):
        axes.plot([x, x + length_um / pixel_size_um], [y, y], color=colour, linewidth=width, solid_capstyle="butt")
    box: dict[str, Any] = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "pad": 1.5}
    label = f"{length_um:g} µm"
    axes.annotate(label, (x, y), xytext=(0, 6), textcoords="offset points", color="white", fontsize=7, bbox=box)


def round_length(longest_um: float) -> float:
    """Return the longest of 1, 2, 5, 10, ... (or 0.5, 0.2, ...) um that is not longer.

    >>> round_length(31.0), round_length(0.07)
    (20.0, 0.05)
    """
    power = 10.0 ** np.floor(np.log10(longest_um))
    return float(f"{max(n * power for n in (1, 2, 5) if n * power <= longest_um * (1 + 1e-9)):.6g}")
