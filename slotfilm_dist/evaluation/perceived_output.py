"""Where drawn pictures go: a video, one image, a folder with a table, or a window."""

import os
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from slotfilm_dist.evaluation.result_files import write_csv

Drawn = UInt8[np.ndarray, "rows columns 3"]


@runtime_checkable
class Output(Protocol):
    """Takes one picture after another; `close` completes it, also after an error."""

    @property
    def closed(self) -> bool:
        """The user has had enough."""
        ...

    def add(self, drawn: Drawn, row: dict[str, Any]) -> None:
        """Take a picture and its numbers."""
        ...

    def close(self) -> None:
        """Complete what was written."""
        ...


def open_output(path: Path, fps: int) -> Output:
    """An output for a path: `.mp4` a video, `.png` the last picture, no suffix a folder.

    Raises:
        ValueError: another suffix.
    """
    match path.suffix.lower():
        case ".mp4":
            return VideoOutput(path, fps)
        case ".png":
            return ImageOutput(path)
        case "":
            return FolderOutput(path)
        case suffix:
            raise ValueError(f"--out {path}: {suffix} cannot be written; use .mp4, .png or a folder's name")


class VideoOutput:
    """An H.264 video with a table of numbers beside it; both appear when they are complete.

    Args:
        path: file to write.
        fps: pictures a second.
    """

    closed = False

    def __init__(self, path: Path, fps: int) -> None:
        self._path = path
        self._fps = fps
        self._partial = path.with_name(f".{path.stem}.partial.mp4")
        self._writer: Any = None
        self._rows: list[dict[str, Any]] = []

    def add(self, drawn: Drawn, row: dict[str, Any]) -> None:
        """Append a picture."""
        if self._writer is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = imageio.get_writer(
                self._partial,
                fps=self._fps,
                codec="libx264",
                pixelformat="yuv420p",
                macro_block_size=2,
                output_params=["-movflags", "+faststart"],
            )
        self._writer.append_data(drawn)
        self._rows.append(row)

    def close(self) -> None:
        """Complete the file; nothing is written without pictures."""
        if self._writer is None:
            return
        self._writer.close()
        self._writer = None
        os.replace(self._partial, self._path)
        write_csv(self._path.with_suffix(".csv"), self._rows)


class ImageOutput:
    """The last picture as one file."""

    closed = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._drawn: Drawn | None = None

    def add(self, drawn: Drawn, row: dict[str, Any]) -> None:
        """Remember it."""
        self._drawn = drawn

    def close(self) -> None:
        """Write it."""
        if self._drawn is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(self._drawn).save(self._path)


class FolderOutput:
    """One numbered image a picture, and `numbers.csv` with a row for each."""

    closed = False

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, Any]] = []

    def add(self, drawn: Drawn, row: dict[str, Any]) -> None:
        """Write the image."""
        self._folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(drawn).save(self._folder / f"{len(self._rows):06d}.png")
        self._rows.append(row)

    def close(self) -> None:
        """Write the table."""
        if self._rows:
            write_csv(self._folder / "numbers.csv", self._rows)


class WindowOutput:
    """A window of OpenCV; q, Escape or its close button ends it."""

    _TITLE = "slotfilm perceive"

    def __init__(self, cv2: Any) -> None:
        self._cv2 = cv2
        self.closed = False

    def add(self, drawn: Drawn, row: dict[str, Any]) -> None:
        """Show it."""
        self._cv2.imshow(self._TITLE, np.ascontiguousarray(drawn[..., ::-1]))
        key = self._cv2.waitKey(1) & 0xFF
        gone = self._cv2.getWindowProperty(self._TITLE, self._cv2.WND_PROP_VISIBLE) < 1
        self.closed = key in (ord("q"), 27) or gone

    def close(self) -> None:
        """Close the window."""
        self._cv2.destroyAllWindows()


def open_window() -> Output:
    """A window; raises ``ValueError`` where OpenCV is missing."""
    try:
        import cv2
    except ImportError as error:
        raise ValueError(f"--show needs OpenCV ({error}): pip install opencv-python") from None
    return WindowOutput(cv2)
