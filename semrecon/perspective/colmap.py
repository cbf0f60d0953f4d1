"""COLMAP on micrographs, by way of its Python package: several set-ups of its incremental mapper, and the best answer.

Its pixels are counted from the corner of the first one, so that centres are halves; ours are whole numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from semrecon.data import Array, TiltSeries
from semrecon.errors import MethodError
from semrecon.matches.correspondence import view_name
from semrecon.matches.features import FeatureOptions, detect_features, normalised_grey, usable_pixels
from semrecon.matches.matching import MatchOptions
from semrecon.matches.unguided_matching import match_all
from semrecon.perspective.pinhole import PinholeReconstruction, Pinholes, intersect

Source = Literal["own", "colmap"]
"""Whose features and matches: ours, or COLMAP's."""
CORNER_PX = 0.5
MOST_PX = 2.0
"""Greatest reprojection error of a sighting; 4 px is COLMAP's own."""
SILENT = 3
"""Level of messages: only those of an abort."""


@dataclass(frozen=True)
class MapperOptions:
    """Set-ups of COLMAP's incremental mapper. Its defaults are for photographs and place no view of a small tilt.

    Parameters
    ----------
    sources
        Whose features and matches are tried.
    refine_focal
        Whether the focal length may move, for each trial.
    least_angle_deg
        Least angle of beams of a point, and of the pair to start from; 1.5 and 16 degrees are COLMAP's own.
    least
        Fewest inliers of a pair and points of a later view.
    features, matches
        Of our own; the ratio of the match test counts for COLMAP's, too.
    peak_threshold
        Of COLMAP's SIFT; its default is 0.0067.
    """

    sources: tuple[Source, ...] = ("own", "colmap")
    refine_focal: tuple[bool, ...] = (False, True)
    least_angle_deg: float = 0.2
    least: int = 15
    features: FeatureOptions = field(default_factory=FeatureOptions)
    matches: MatchOptions = field(default_factory=MatchOptions)
    peak_threshold: float = 0.004


@dataclass(frozen=True)
class Mapped:
    """Answer of one set-up.

    Parameters
    ----------
    found
        Cameras and points.
    source, refined
        The set-up.
    """

    found: PinholeReconstruction
    source: Source
    refined: bool

    @property
    def rank(self) -> tuple[int, float]:
        """Views placed, then the smaller error."""
        return int(self.found.cameras.placed.sum()), -self.found.sigma_px


def mapped(series: TiltSeries, focal_px: float, seed: int, options: MapperOptions) -> tuple[Mapped, ...]:
    """Run every set-up and return what those that placed the reference view found, the best first.

    Everything happens in a temporary folder, in one thread and with a fixed seed.

    Raises
    ------
    MethodError
        Where COLMAP is not installed, a view is blank, or no set-up places the reference view and another.
    """
    library = _library()
    answers = []
    with TemporaryDirectory(prefix="semrecon_") as name, _silent(library):
        folder = Path(name)
        _write_pictures(series, folder)
        for source in options.sources:
            database = folder / f"{source}.db"
            _fill(library, database, series, focal_px, source, seed, options)
            for refined in options.refine_focal:
                output = folder / f"{source}_{refined}"
                output.mkdir()
                models = library.incremental_mapping(
                    database, folder / "images", output, _mapper(library, seed, options, refined)
                )
                found = (_reconstruction(model, series) for model in models.values())
                answers += [Mapped(one, source, refined) for one in found if one is not None]
    if not answers:
        raise MethodError(
            f"COLMAP places {view_name(series, series.reference)} and another view in none of its set-ups: the images "
            "show too little perspective, or too few matches"
        )
    return tuple(sorted(answers, key=lambda one: one.rank, reverse=True))


def _library() -> Any:
    """Import pycolmap, which is an optional extra."""
    try:
        import pycolmap
    except ImportError as error:
        raise MethodError(
            "incremental_sfm needs the package pycolmap, which is not installed; install semrecon with its extra sfm"
        ) from error
    return pycolmap


@contextmanager
def _silent(library: Any) -> Iterator[None]:
    """Keep COLMAP's log out of the terminal and off the disk."""
    before = library.logging.minloglevel
    library.logging.minloglevel = SILENT
    try:
        yield
    finally:
        library.logging.minloglevel = before


def _write_pictures(series: TiltSeries, folder: Path) -> None:
    """Write views as 8 bit pictures, and masks where COLMAP looks for them."""
    import cv2

    (folder / "images").mkdir()
    (folder / "masks").mkdir()
    for index, view in enumerate(series.views):
        usable = usable_pixels(view)
        grey = normalised_grey(view.image, usable, FeatureOptions().percentiles, view_name(series, index))
        cv2.imwrite(str(folder / "images" / _file(index)), grey)
        cv2.imwrite(str(folder / "masks" / f"{_file(index)}.png"), usable.astype(np.uint8) * 255)


def _file(index: int) -> str:
    return f"{index:04d}.png"


def _fill(
    library: Any,
    database: Path,
    series: TiltSeries,
    focal_px: float,
    source: Source,
    seed: int,
    options: MapperOptions,
) -> None:
    """Write one camera, the features and the verified matches of all views into a database."""
    images, reader, single = database.parent / "images", library.ImageReaderOptions(), library.CameraMode.SINGLE
    reader.camera_model = "SIMPLE_PINHOLE"
    reader.camera_params = ",".join(f"{value:.9g}" for value in (focal_px, *(series.optics.centre_px + CORNER_PX)))
    geometry = library.TwoViewGeometryOptions()
    geometry.min_num_inliers = options.least
    geometry.ransac.random_seed = seed
    library.Database.open(database).close()
    if source == "own":
        library.import_images(database, images, single, options=reader)
        _write_matches(library, database, series, options)
        verifier = library.GeometricVerifierOptions()
        verifier.num_threads = 1
        library.geometric_verification(database, verifier, two_view_geometry_options=geometry)
        return
    reader.mask_path = database.parent / "masks"
    extraction, matching = library.FeatureExtractionOptions(), library.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = 1
    extraction.use_gpu = matching.use_gpu = False
    extraction.sift.upright, extraction.sift.peak_threshold = True, options.peak_threshold
    matching.sift.max_ratio = options.matches.ratio
    cpu = library.Device.cpu
    library.extract_features(
        database, images, camera_mode=single, reader_options=reader, extraction_options=extraction, device=cpu
    )
    library.match_exhaustive(database, matching, verification_options=geometry, device=cpu)


def _write_matches(library: Any, database: Path, series: TiltSeries, options: MapperOptions) -> None:
    features = [detect_features(view, options.features) for view in series.views]
    with library.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        own = [ids[_file(index)] for index in range(len(series))]
        for index, one in enumerate(features):
            opened.write_keypoints(own[index], (one.xy_px + CORNER_PX).astype(np.float32))
        for first, second in combinations(range(len(series)), 2):
            found = match_all(features[first], features[second], options.matches)
            if len(found):
                both = np.column_stack([found.index1, found.index2]).astype(np.uint32)
                opened.write_matches(own[first], own[second], both)


def _mapper(library: Any, seed: int, options: MapperOptions, refined: bool) -> Any:
    """Options of the mapper for long focal lengths, small angles and few views."""
    given = library.IncrementalPipelineOptions()
    given.num_threads, given.random_seed = 1, seed
    given.extract_colors, given.min_model_size, given.min_num_matches = False, 2, options.least
    given.ba_refine_focal_length, given.ba_refine_extra_params = refined, False
    given.mapper.abs_pose_refine_focal_length = refined
    given.mapper.init_min_num_inliers = given.mapper.abs_pose_min_num_inliers = options.least
    given.mapper.init_min_tri_angle = given.mapper.ba_local_min_tri_angle = options.least_angle_deg
    given.mapper.filter_min_tri_angle = given.triangulation.min_angle = options.least_angle_deg
    given.mapper.filter_max_reproj_error = given.triangulation.complete_max_reproj_error = MOST_PX
    given.triangulation.merge_max_reproj_error = MOST_PX
    given.mapper.init_max_forward_motion = 1.0
    given.triangulation.ignore_two_view_tracks = False
    for part in (given, given.mapper, given.triangulation):
        part.max_focal_length_ratio = 1e4
    return given


def _reconstruction(model: Any, series: TiltSeries) -> PinholeReconstruction | None:
    """Read cameras and points of a model; None without the reference view, another one, or points."""
    views = {image_id: int(Path(model.image(image_id).name).stem) for image_id in model.reg_image_ids()}
    if series.reference not in views.values() or len(views) < 2 or model.num_points3D() < 3:
        return None
    count = len(series)
    rotations, shifts = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    for image_id, view in views.items():
        pose = model.image(image_id).cam_from_world()
        rotations[view], shifts[view] = pose.rotation.matrix(), pose.translation
    camera = next(iter(model.cameras.values()))
    cameras = Pinholes(rotations, shifts, float(camera.mean_focal_length()), series.optics.centre_px)
    points = [model.point3D(i) for i in sorted(model.point3D_ids())]
    sightings = _sightings(model, points, views, count)
    covariance = intersect(sightings, cameras)[1]
    known = np.isfinite(covariance).all(axis=(1, 2))
    xyz = np.array([point.xyz for point in points])
    return PinholeReconstruction(cameras, xyz[known], covariance[known], sightings[known]) if known.sum() > 2 else None


def _sightings(model: Any, points: Sequence[Any], views: dict[int, int], count: int) -> Array:
    xy_px = np.full((len(points), count, 2), np.nan)
    places = {i: np.array([p.xy for p in model.image(i).points2D]).reshape(-1, 2) for i in views}
    for row, point in enumerate(points):
        for element in point.track.elements:
            xy_px[row, views[element.image_id]] = places[element.image_id][element.point2D_idx] - CORNER_PX
    return xy_px
