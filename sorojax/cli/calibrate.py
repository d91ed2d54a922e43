"""`sorojax calibrate`: a camera from pictures of a ChArUco board, or the board to print."""

import argparse
from pathlib import Path


def add(commands) -> None:
    """The parser of the command."""
    parser = commands.add_parser("calibrate", help="a camera from pictures of a ChArUco board")
    parser.add_argument("images", nargs="*", type=Path, help="pictures of the board")
    parser.add_argument("--out", type=Path, default=Path("camera.json"))
    parser.add_argument("--columns", type=int, default=8)
    parser.add_argument("--rows", type=int, default=6)
    parser.add_argument("--square", type=float, default=30.0, help="side of a square [mm]")
    parser.add_argument("--marker", type=float, default=22.0, help="side of a marker [mm]")
    parser.add_argument("--print", type=Path, dest="board", help="write the board to print")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the camera and print what it is.

    Raises:
        ValueError: If there are too few good pictures.
    """
    import cv2

    from sorojax import vision

    board = vision.CharucoBoard(
        arguments.columns, arguments.rows, arguments.square * 1e-3, arguments.marker * 1e-3
    )
    if arguments.board is not None:
        cv2.imwrite(str(arguments.board), board.picture())
        print(f"wrote {arguments.board}: print it at 4 pixels per millimetre")
        return 0
    images = []
    for path in arguments.images:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f"{path} is no image. Give pictures of the board.")
        images.append(image)
    camera = vision.calibrate(images, board)
    vision.save_camera(arguments.out, camera)
    print(
        f"focal length {camera.fx:.1f}, {camera.fy:.1f} px, centre {camera.cx:.1f}, "
        f"{camera.cy:.1f} px, error {camera.rms:.3f} px rms\nwrote {arguments.out}"
    )
    return 0
