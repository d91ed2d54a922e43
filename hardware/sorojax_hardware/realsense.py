"""Intel RealSense cameras, live and recorded."""

from pathlib import Path
from typing import Any

import numpy as np

from sorojax_hardware.protocols import Image


def realsense() -> Any:
    """The module `pyrealsense2`.

    Raises:
        ImportError: If it, or the library libusb that it needs, is missing.
    """
    try:
        import pyrealsense2
    except ImportError as missing:
        hint = (
            "the system has no libusb. sudo apt install libusb-1.0-0"
            if "libusb" in str(missing)
            else "pip install 'sorojax[hardware]'"
        )
        raise ImportError(f"RealSenseCamera: need pyrealsense2; {hint}") from missing
    return pyrealsense2


class RealSenseCamera:
    """Colour and depth, the depth seen from the colour camera.

    `intrinsics` has what `sorojax.vision.Camera` takes: fx, fy, cx, cy, distortion, width,
    height. Reading does not wait.
    """

    def __init__(
        self,
        *,
        size: tuple[int, int] = (640, 480),
        rate: int = 60,
        emitter: bool = False,
        recording: str | Path | None = None,
        record: str | Path | None = None,
    ):
        """
        Args:
            size: Width and height [px].
            rate: Images a second.
            emitter: Whether to project the infrared pattern; it disturbs colour markers.
            recording: Play this file instead of a camera, each image once.
            record: Also write what is seen to this file, .db3 since version 2.59.

        Raises:
            ConnectionError: If there is no camera.
            ImportError: If pyrealsense2 or libusb is missing.
        """
        rs = realsense()
        config = rs.config()
        if recording is not None:
            config.enable_device_from_file(str(recording), repeat_playback=False)
        else:
            config.enable_stream(rs.stream.color, *size, rs.format.bgr8, rate)
            config.enable_stream(rs.stream.depth, *size, rs.format.z16, rate)
        if record is not None:
            config.enable_record_to_file(str(record))
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as reason:
            raise ConnectionError(
                f"RealSenseCamera: no camera opens ({reason}). Check the USB 3 cable, or give "
                "`recording` a file that the camera's own recorder wrote."
            ) from reason
        if recording is not None:  # at the pace of the reader, so that no image is left out
            profile.get_device().as_playback().set_real_time(False)
        sensor = profile.get_device().first_depth_sensor()
        self._scale = float(sensor.get_depth_scale())
        if recording is None and sensor.supports(rs.option.emitter_enabled):
            sensor.set_option(rs.option.emitter_enabled, float(emitter))
        lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        self.intrinsics = {
            "fx": lens.fx, "fy": lens.fy, "cx": lens.ppx, "cy": lens.ppy,
            "distortion": tuple(lens.coeffs), "width": lens.width, "height": lens.height,
        }  # fmt: skip
        self._align = rs.align(rs.stream.color)

    def read(self) -> Image | None:
        frames = self._pipeline.poll_for_frames()
        if not frames or not frames.get_color_frame() or not frames.get_depth_frame():
            return None
        together = self._align.process(frames)
        colour, depth = together.get_color_frame(), together.get_depth_frame()
        metres = np.asarray(depth.get_data()).astype(np.float32) * self._scale
        return Image(colour.get_timestamp() * 1e-3, np.array(colour.get_data()), metres)

    def close(self) -> None:
        self._pipeline.stop()
