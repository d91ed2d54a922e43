"""A live view in viser (extra `live`): orbit, pick, and add to its scene."""

import contextlib
import sys

import numpy as np

from sorojax.rod import num_coordinates
from sorojax.view import style
from sorojax.view.live_sinks import AbstractSink
from sorojax.view.rigging import Rig, pose


class Viser(AbstractSink):
    """Serves a rig in a viser scene, to browsers of this machine only.

    Args:
        rig: What is shown; its coordinates are sent.
        port: Of the page; one above that is free if it is taken.
        title: Above the scene.
        fps: Most frames per second.

    Raises:
        ModuleNotFoundError: In the viewer process, without the extra `live`.
    """

    def __init__(self, rig: Rig, port: int = 8080, title: str = "robot", fps: float = 30.0):
        self.rig, self.port, self.title, self.fps = rig, port, title, fps
        self.size = num_coordinates(rig.model)

    def open(self) -> str:
        try:
            import viser
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "Viser: viser is not installed. pip install 'sorojax[live]', or pass the rig "
                "itself to view.live for the page that needs nothing."
            ) from error
        with contextlib.redirect_stdout(sys.stderr):  # where `live` waits for its own word
            self._server = viser.ViserServer("127.0.0.1", self.port, self.title, verbose=False)
        self._server.scene.set_up_direction("+z")
        self._mesh = self._server.scene.add_mesh_simple(
            "/robot", self._points(None), np.asarray(self.rig.triangles),
            color=tuple(bytes.fromhex(style.BODY[1:])), side="double",
        )  # fmt: skip
        self._stamp = self._server.gui.add_text("time", "waiting", disabled=True)
        return f"http://127.0.0.1:{self._server.get_port()}/"

    def show(self, time: float, values: np.ndarray) -> None:
        self._mesh.vertices = self._points(values)
        self._stamp.value = f"t = {time:.2f} s"

    def close(self) -> None:
        self._server.flush()
        self._server.stop()

    def _points(self, values: np.ndarray | None) -> np.ndarray:
        points = np.asarray(pose(self.rig, values), np.float32)
        return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
