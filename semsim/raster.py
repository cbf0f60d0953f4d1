"""OpenGL rasterisation through pyrender: a second, independent way to the surface buffer.

Two habits of pyrender 0.1.45 would spoil sub-pixel truth. It turns every depth buffer into distances as if the camera
were perspective; that is undone here. And its buffer is multisampled, with the depth of the first sample kept, which
lies off the pixel centre; the segmentation pass switches multisampling off, so every sample is the centre's.
"""

from __future__ import annotations

import os
import warnings
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from semsim.errors import InputError
from semsim.mesh import Array, Mesh
from semsim.microscope import Microscope, Pose, camera_from_world, pixel_grid, pixel_rays
from semsim.raycast import bounding_sphere, search_tree, tensor

GL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""OpenGL looks along -z with y up; our camera along +z with y down."""


def rasterise(mesh: Mesh, microscope: Microscope, pose: Pose) -> tuple[Array, NDArray[np.int32]]:
    """Draw one view.

    Returns
    -------
    depth_um, face
        (rows, columns) X_cam_z, NaN for a miss, and the triangle nearest to the point drawn, -1 for a miss.

    Raises
    ------
    InputError
        The projection is not parallel.
    """
    if microscope.working_distance_um is not None:
        raise InputError("backend pyrender draws parallel projection only; with working_distance_um use raycast")
    camera = camera_from_world(pose, mesh.vertices_um)
    camera[:, :2] = camera[:, :2] @ pose.distortion.T
    top, bottom = camera[:, 2].min(), camera[:, 2].max()
    reach = 1.01 * max(bottom - top, microscope.pixel_size_um)
    # The eye stands one reach above the top and the far plane two below the eye: there the depth buffer and its
    # perspective linearisation both keep about 1e-7 of the reach.
    eye = top - reach
    distance = draw(mesh, microscope, camera - [0.0, 0.0, eye], near=0.99 * reach, far=2.0 * reach)
    depth = np.where(np.isnan(distance), np.nan, distance + eye)
    return depth, _nearest_face(mesh, microscope, pose, depth)


def parallel_distance(perspective: Array, near: float, far: float) -> Array:
    """Distance in an orthographic view from what pyrender makes of its depth buffer; 0 (nothing drawn) becomes NaN.

    pyrender answers ``d = 2 n f / (f + n - ndc (f - n))``; an orthographic camera has ``ndc`` linear in distance.
    """
    with np.errstate(divide="ignore"):
        ndc = (far + near - 2 * near * far / perspective) / (far - near)
    return np.asarray(np.where(perspective > 0, near + (ndc + 1) / 2 * (far - near), np.nan))


def draw(mesh: Mesh, microscope: Microscope, camera_um: Array, near: float, far: float) -> Array:
    """Distance from the eye in the plane z = 0 of the camera, (rows, columns); NaN where nothing is drawn.

    Parameters
    ----------
    camera_um
        (vertices, 3) corners of the mesh, camera frame, between the planes at `near` and `far`.
    """
    pyrender = _pyrender()
    half = np.array([microscope.width_px, microscope.height_px]) * microscope.pixel_size_um / 2
    primitive = pyrender.Primitive(
        positions=camera_um @ GL_FROM_CAMERA, indices=mesh.faces, mode=pyrender.GLTF.TRIANGLES
    )
    scene = pyrender.Scene()
    node = scene.add(pyrender.Mesh([primitive]))
    scene.add(pyrender.OrthographicCamera(half[0], half[1], znear=near, zfar=far), pose=np.eye(4))
    flags = pyrender.RenderFlags.SEG | pyrender.RenderFlags.SKIP_CULL_FACES
    renderer = pyrender.OffscreenRenderer(microscope.width_px, microscope.height_px)
    try:
        _, drawn = renderer.render(scene, flags, seg_node_map={node: (255, 255, 255)})
    finally:
        renderer.delete()
    return parallel_distance(drawn.astype(np.float64), near, far)


def _nearest_face(mesh: Mesh, microscope: Microscope, pose: Pose, depth: Array) -> NDArray[np.int32]:
    face = np.full(depth.shape, -1, dtype=np.int32)
    origins, directions = pixel_rays(microscope, pose, pixel_grid(microscope))
    drawn = np.isfinite(depth)
    points = (origins + depth[..., None] * directions)[drawn]
    centred = points - bounding_sphere(mesh)[0]
    answer = search_tree(mesh).compute_closest_points(tensor(centred, np.float32))
    face[drawn] = answer["primitive_ids"].numpy().astype(np.int32)
    return face


def _pyrender() -> ModuleType:
    """Import pyrender for rendering without a display; its own imports warn of other people's deprecations."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import pyrender
        except ImportError as error:
            raise InputError(f"backend pyrender finds no OpenGL here ({error}); install EGL or use raycast") from error
    return pyrender  # type: ignore[no-any-return]
