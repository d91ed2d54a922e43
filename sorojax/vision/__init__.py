"""Vision: from an image to points. Pure functions over NumPy arrays; OpenCV where used."""

from sorojax._arguments import check_package as _check_package
from sorojax.vision.camera import (
    Camera as Camera,
    Pose as Pose,
    deproject as deproject,
    depth_at as depth_at,
    load_camera as load_camera,
    project as project,
    rays as rays,
    save_camera as save_camera,
)
from sorojax.vision.discs import (
    BLUE as BLUE,
    GREEN as GREEN,
    RED as RED,
    Colour as Colour,
    Discs as Discs,
    MarkerStream as MarkerStream,
    Tracks as Tracks,
    colour_mask as colour_mask,
    find_discs as find_discs,
    follow as follow,
    hough_discs as hough_discs,
    refine_discs as refine_discs,
    start_tracks as start_tracks,
)
from sorojax.vision.fiducials import (
    CharucoBoard as CharucoBoard,
    Fiducials as Fiducials,
    calibrate as calibrate,
    find_fiducials as find_fiducials,
    marker_corners as marker_corners,
    marker_pose as marker_pose,
    world_frame as world_frame,
)
from sorojax.vision.synthetic import (
    Balls as Balls,
    Disturbance as Disturbance,
    background as background,
    draw_balls as draw_balls,
    draw_discs as draw_discs,
    draw_plane as draw_plane,
    fiducial_picture as fiducial_picture,
    photograph as photograph,
)

_check_package(__name__)
