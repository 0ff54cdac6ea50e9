"""A video of patches of known colours, by either standard's matrix."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

COLORS = np.array([(200, 30, 30), (30, 160, 60), (40, 60, 180), (128, 128, 128), (220, 200, 60), (90, 40, 120)])
_SIDE_PX = 32
_LUMA = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}  # of red and blue: ITU-R BT.601 and BT.709
_TAG = {"bt601": 1, "bt709": 2}  # color_space of VP9's uncompressed header
_SYNC = b"\x49\x83\x42"


def colored_film(path: Path, standard: str) -> Path:
    """Write ten equal frames by VP9: OpenCV encodes as BT.601, so colours are turned first, and the tag set after."""
    turn = np.linalg.inv(_ycbcr("bt601")) @ _ycbcr(standard)
    strip = np.repeat(COLORS @ turn.T, _SIDE_PX, axis=0).round().clip(0, 255).astype(np.uint8)
    frame = np.tile(strip, (2 * _SIDE_PX, 1, 1))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP90"), 10, frame.shape[1::-1])
    for _ in range(10):
        writer.write(frame[..., ::-1])
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.index(_SYNC) + len(_SYNC)  # of the only key frame: a colour space of three bits follows
    assert data.count(_SYNC) == 1
    data[at] = data[at] & 0x1F | _TAG[standard] << 5
    path.write_bytes(data)
    return path


def patches(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The median colour in the middle of each patch, (6, 3)."""
    columns = _SIDE_PX * np.arange(len(COLORS)) + _SIDE_PX // 2
    return np.array([np.median(image[24:40, x - 8 : x + 8].reshape(-1, 3), axis=0) for x in columns])


def _ycbcr(standard: str) -> NDArray[np.float64]:
    red, blue = _LUMA[standard]
    luma = np.array([red, 1 - red - blue, blue])
    return np.stack((luma, (np.eye(3)[2] - luma) / (2 - 2 * blue), (np.eye(3)[0] - luma) / (2 - 2 * red)))
