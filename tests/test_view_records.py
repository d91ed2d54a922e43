"""Pictures of what is told rather than built."""

import numpy as np
import pytest

from sorojax import io, mesh, sdf, view
from sorojax.sweep.sweep import Swept
from sorojax.view import style
from sorojax.vision import Discs
from sorojax.vision.discs import Tracks
from tests.test_view_answers import rgb
from tests.test_view_show import is_whole, near, patch, pixels, words


def test_quality_has_its_histogram_and_angles():
    found = mesh.quality(mesh.triangulate(sdf.Circle([0, 0], 1.0), size=0.4))
    shown = view.show(found)
    axes = shown.panels[0].axes
    assert is_whole(shown) and f"{found.num_cells} cells" in words(shown)
    assert [bar.get_height() for bar in axes.patches] == list(found.histogram)


def test_a_boundary_shows_its_line_and_corners():
    (curve,) = sdf.contour(sdf.Rectangle([0, 0], [0.02, 0.01]), 2e-3)
    shown = view.show(curve)
    corners = curve.points[curve.corner]
    assert is_whole(shown) and len(corners) == 4
    image = pixels(shown)
    for corner in corners:
        assert near(patch(shown, image, corner[None]), rgb(style.COLOURS[1]), 12).any()


@pytest.mark.parametrize("frame", [0, -1])
def test_a_moving_surface_shows_the_frame_asked_for(frame):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, 3] = 5.0
    moving = io.MovingSurface(points[None], triangles, poses, np.full(3, 0.5), "block")
    shown = view.show(moving, frame=frame)
    assert is_whole(shown) and "block" in words(shown)
    image = pixels(shown)
    centre = points.mean(axis=0) + poses[frame, :3, 3]
    assert not near(patch(shown, image, centre[None]), (255, 255, 255), 12).any()


def test_a_sweep_shows_every_number_over_the_designs():
    result = {"force": np.arange(5.0), "field": np.ones((5, 3)), "name": np.array(["a"] * 5)}
    shown = view.show(Swept(result, ("k",), 5, 0, "hash"))
    assert is_whole(shown) and len(shown.panels) == 2
    text = words(shown)
    assert "force" in text and "field" in text and "name" not in text and "5 designs" in text
    with pytest.raises(ValueError, match="holds no numbers"):
        view.show(Swept({"name": np.array(["a"])}, ("k",), 1, 0, "hash"))


def test_tracks_show_who_was_not_seen():
    discs = Discs(np.array([[100.0, 50.0], [200.0, 80.0]]), np.full(2, 20.0), np.zeros(2, int))
    velocity = np.array([[0.0, 40.0], [0.0, -40.0]])
    shown = view.show(Tracks(discs, velocity, np.array([0, 3])))
    assert is_whole(shown) and "1 stale" in words(shown)
    image, aside = pixels(shown), np.array([[-10.0, -2.0]])
    places = 1e-3 * (discs.centre + aside)  # [m] of a picture, whose axes are [mm] or [px]
    seen = near(patch(shown, image, places[:1]), rgb(style.COLOURS[0]), 60)
    grey = patch(shown, image, places[1:])
    assert seen.mean() > 0.5 and np.ptp(grey.astype(int), axis=-1).max() < 10
