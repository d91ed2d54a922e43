"""Vision: from an image to points. Pure functions over NumPy arrays; OpenCV where used."""

from sorojax._arguments import check_package as _check_package
from sorojax.vision.camera import (
    Camera,
    Pose,
    deproject,
    depth_at,
    load_camera,
    on_plane,
    project,
    save_camera,
)
from sorojax.vision.discs import (
    BLUE,
    GREEN,
    RED,
    Colour,
    Discs,
    MarkerStream,
    colour_mask,
    find_discs,
    follow,
    hough_discs,
    refine_discs,
    start_tracks,
)
from sorojax.vision.fiducials import (
    CharucoBoard,
    calibrate,
    find_fiducials,
    marker_corners,
    marker_pose,
    world_frame,
)
from sorojax.vision.synthetic import (
    Balls,
    Disturbance,
    background,
    draw_balls,
    draw_discs,
    draw_plane,
    fiducial_picture,
    photograph,
)

__all__ = [
    "BLUE",
    "GREEN",
    "RED",
    "Balls",
    "Camera",
    "CharucoBoard",
    "Colour",
    "Discs",
    "Disturbance",
    "MarkerStream",
    "Pose",
    "background",
    "calibrate",
    "colour_mask",
    "deproject",
    "depth_at",
    "draw_balls",
    "draw_discs",
    "draw_plane",
    "fiducial_picture",
    "find_discs",
    "find_fiducials",
    "follow",
    "hough_discs",
    "load_camera",
    "marker_corners",
    "marker_pose",
    "on_plane",
    "photograph",
    "project",
    "refine_discs",
    "save_camera",
    "start_tracks",
    "world_frame",
]

_check_package(__name__)
