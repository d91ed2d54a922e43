"""Sources of images."""

import sys
import time

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

from sorojax_hardware import (  # noqa: E402
    Camera,
    DrawnCamera,
    FolderCamera,
    Image,
    Latest,
    RealSenseCamera,
    SimulatedClock,
    VideoCamera,
)


def grey(level):
    return np.full((48, 64, 3), level, np.uint8)


def test_a_drawn_camera_has_an_image_when_one_is_due():
    clock = SimulatedClock(100.0)
    camera = DrawnCamera(lambda t: (grey(int(100 * t)), np.ones((48, 64))), clock, rate=50.0)
    assert isinstance(camera, Camera)
    times = []
    for k in range(21):
        clock.sleep_until(100.0 + 0.005 * k)
        image = camera.read()
        if image is not None:
            times.append(image.time)
            assert image.colour[0, 0, 0] == int(100 * (image.time - 100.0) + 1e-6)
            assert image.depth is not None
    assert np.allclose(times, 100.0 + 0.02 * np.arange(6))


def test_a_folder_of_images(tmp_path):
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), grey(10 * k))
    np.save(tmp_path / "1.depth.npy", np.full((48, 64), 0.5))
    camera = FolderCamera(tmp_path, rate=10.0)
    images = [camera.read() for _ in range(4)]
    assert images[3] is None
    assert [image.time for image in images[:3]] == [0.0, 0.1, 0.2]
    assert [image.colour[5, 5, 1] for image in images[:3]] == [0, 10, 20]
    assert images[0].depth is None and images[1].depth[3, 3] == 0.5
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(ValueError, match="2 times for 3"):
        FolderCamera(tmp_path)
    (tmp_path / "times.txt").unlink()
    (tmp_path / "0.png").write_text("<html>")
    with pytest.raises(ValueError, match="no image"):
        FolderCamera(tmp_path).read()
    np.save(tmp_path / "1.depth.npy", np.array([{}]), allow_pickle=True)
    camera = FolderCamera(tmp_path)
    camera._next = 1
    with pytest.raises(ValueError, match="pickle"):
        camera.read()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no .png"):
        FolderCamera(tmp_path / "empty")


def test_a_video_file(tmp_path):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    for k in range(5):
        writer.write(grey(40 * k))
    writer.release()
    camera = VideoCamera(path)
    images = [camera.read() for _ in range(6)]
    assert images[5] is None
    assert [image.time for image in images[:5]] == [0.0, 0.05, 0.1, 0.15, 0.2]
    assert all(abs(int(im.colour[9, 9, 0]) - 40 * k) < 4 for k, im in enumerate(images[:5]))
    camera.close()
    with pytest.raises(ConnectionError, match="video file"):
        VideoCamera(tmp_path / "none.avi")


class Script:
    """A camera that gives what it is told, and remembers that it was closed."""

    def __init__(self, images):
        self.images, self.closed = list(images), False

    def read(self):
        if not self.images:
            return None
        image = self.images.pop(0)
        if isinstance(image, Exception):
            raise image
        return image

    def close(self):
        self.closed = True


def wait_for(condition):
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < 5
        time.sleep(0.001)


@pytest.mark.stress(54)
def test_latest_drops_what_is_old():
    """Three images, one of them of the past, one twice: the newest is what a loop sees."""
    source = Script([Image(t, grey(0)) for t in (0.0, 0.1, 0.05, 0.1)])
    camera = Latest(source)
    wait_for(lambda: not source.images and camera.dropped == 3)
    image = camera.read()
    assert image is not None and image.time == 0.1 and camera.read() is None
    camera.close()
    assert source.closed


@pytest.mark.stress(54)
def test_latest_tells_what_went_wrong():
    camera = Latest(Script([OSError("cable")]))
    wait_for(lambda: camera._error is not None)
    with pytest.raises(OSError, match="cable"):
        camera.read()
    assert camera.read() is None
    camera.close()


@pytest.mark.parametrize(
    ("reason", "hint"),
    [
        ("libusb-1.0.so.0: cannot open shared object file", "apt install libusb-1.0-0"),
        ("No module named 'pyrealsense2'", "pip install 'sorojax"),
    ],
)
def test_realsense_tells_what_is_missing(monkeypatch, reason, hint):
    class Finder:
        @staticmethod
        def find_spec(name, path=None, target=None):
            if name == "pyrealsense2":
                raise ImportError(reason)

    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])
    with pytest.raises(ImportError, match=f"RealSenseCamera: .*{hint}"):
        RealSenseCamera()


def recorded(rs, path, width=64, height=48, count=8):
    """A film that the SDK's recorder makes of a camera in software: depth 500 + n mm, grey
    10 n."""
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy = width, height, 60.0, 60.0
    lens.ppx, lens.ppy, lens.model, lens.coeffs = 31.5, 23.5, rs.distortion.none, [0] * 5
    camera, same = rs.software_device(), rs.extrinsics()
    same.rotation, same.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
    kinds = ((rs.stream.depth, rs.format.z16, 2), (rs.stream.color, rs.format.bgr8, 3))
    sensors = [camera.add_sensor(name) for name in ("Stereo Module", "RGB Camera")]
    profiles = []
    for number, (sensor, (kind, form, size)) in enumerate(zip(sensors, kinds, strict=True)):
        video = rs.video_stream()
        video.type, video.index, video.uid, video.fps = kind, 0, number, 30
        video.width, video.height, video.bpp, video.fmt = width, height, size, form
        video.intrinsics = lens
        profiles.append(sensor.add_video_stream(video))
    sensors[0].add_read_only_option(rs.option.depth_units, 0.001)
    profiles[0].register_extrinsics_to(profiles[1], same)
    recorder = rs.recorder(str(path), camera)
    taps = recorder.query_sensors()
    for tap, profile in zip(taps, profiles, strict=True):
        tap.open(profile)
        tap.start(lambda frame: None)
    for n in range(1, count + 1):
        depth = np.full((height, width), 500 + n, np.uint16)
        pictures = (depth, np.full((height, width, 3), 10 * n, np.uint8))
        for sensor, profile, picture, (_, _, size) in zip(
            sensors, profiles, pictures, kinds, strict=True
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = picture, size * width, size
            frame.timestamp, frame.domain = n * 33.3, rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = n, profile.as_video_stream_profile()
            sensor.on_video_frame(frame)
        time.sleep(0.02)
    time.sleep(0.3)  # the recorder writes behind
    for tap in taps:
        tap.stop()
        tap.close()


def test_realsense_plays_what_its_recorder_wrote(tmp_path):
    """Runs where pyrealsense2 and libusb are there, without a camera."""
    try:
        import pyrealsense2 as rs
    except ImportError as missing:
        pytest.skip(str(missing))
    recorded(rs, tmp_path / "film.db3")
    camera = RealSenseCamera(recording=tmp_path / "film.db3")
    assert camera.intrinsics["fx"] == 60.0 and camera.intrinsics["cy"] == 23.5
    images, start = [], time.monotonic()
    while time.monotonic() - start < 10 and len(images) < 6:
        image = camera.read()
        if image is not None:
            images.append(image)
    camera.close()
    assert len(images) == 6
    for image in images:
        n = round(image.time / 33.3e-3)
        assert image.colour.shape == (48, 64, 3) and np.all(image.colour == 10 * n)
        assert image.depth is not None and np.allclose(image.depth, 0.5 + 1e-3 * n, atol=1e-6)


def test_realsense_without_a_camera_says_what_is_missing():
    with pytest.raises((ImportError, ConnectionError), match="RealSenseCamera: "):
        RealSenseCamera()
