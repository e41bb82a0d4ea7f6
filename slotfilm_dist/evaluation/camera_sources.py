"""Pictures from outside the simulator: an image, a folder of images, a video file, a webcam, an MJPEG stream."""

import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from http.client import HTTPException
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from slotfilm_dist.evaluation.mjpeg import StreamBroken, jpeg_parts

Picture = UInt8[np.ndarray, "height width 3"]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".gif")


def pictures(source: str, timeout_s: float) -> Iterator[Picture]:
    """The pictures of a source, in order; a live one gives its newest picture and skips what came before.

    Args:
        source: path of an image, a folder or a video, number of a webcam, or http address of an MJPEG stream.
        timeout_s: longest wait for a picture of a live source.

    Raises:
        ValueError: no such source, or nothing that can be read as pictures.
        StreamBroken: a live source broke off or fell silent.
    """
    if source.startswith(("http://", "https://")):
        return _newest(lambda: mjpeg_pictures(source, timeout_s), timeout_s, source)
    if source.isdigit():
        return _newest(lambda: webcam_pictures(int(source)), timeout_s, f"webcam {source}")
    path = Path(source)
    if path.is_dir():
        return folder_pictures(path)
    if not path.exists():
        raise ValueError(
            f"{source} does not exist: give an image, a folder, a video, a webcam's number or an http address"
        )
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return video_pictures(path)
    return iter([read_image(path)])


def read_image(path: Path) -> Picture:
    """One image file; raises ``ValueError`` if it is none."""
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise ValueError(f"{path} cannot be read as an image: {error}") from None


def folder_pictures(folder: Path) -> Iterator[Picture]:
    """The image files of a folder by name; raises ``ValueError`` if it holds none."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise ValueError(f"{folder} holds no image ({', '.join(IMAGE_SUFFIXES)})")
    return (read_image(path) for path in paths)


def video_pictures(path: Path) -> Iterator[Picture]:
    """The frames of a video file; raises ``ValueError`` if it cannot be decoded."""
    try:
        reader = imageio.get_reader(path)
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} cannot be read as a video: {error}") from None
    with reader:
        frames = iter(reader)  # type: ignore[call-overload]  # imageio's type leaves out that readers can be iterated
        while True:
            try:
                frame = np.asarray(next(frames))
            except StopIteration:
                return
            except (OSError, RuntimeError, IndexError) as error:
                raise StreamBroken(f"{path} breaks off: {error}") from None
            yield _three_channels(frame)


def _three_channels(frame: UInt8[np.ndarray, "height width *channels"]) -> Picture:
    """A grey frame in three channels, one with transparency without it."""
    grey = frame.ndim == 2 or frame.shape[2] < 3
    return np.ascontiguousarray(
        np.stack([frame.reshape(*frame.shape[:2], -1)[..., 0]] * 3, 2) if grey else frame[..., :3]
    )


def webcam_pictures(index: int) -> Iterator[Picture]:
    """The pictures of a webcam, through OpenCV, which SAPIEN brings with it.

    Raises:
        ValueError: OpenCV is missing, or there is no such camera.
        StreamBroken: the camera stops.
    """
    try:
        import cv2
    except ImportError as error:
        raise ValueError(f"a webcam needs OpenCV ({error}): pip install opencv-python-headless") from None
    cv2.utils.logging.setLogLevel(
        cv2.utils.logging.LOG_LEVEL_SILENT
    )  # its drivers' chatter says less than the errors below
    capture = cv2.VideoCapture(index)
    try:
        if not capture.isOpened():
            raise ValueError(f"webcam {index} cannot be opened: is it connected, and may this user read it?")
        while True:
            ok, frame = capture.read()
            if not ok:
                raise StreamBroken(f"webcam {index} stopped giving pictures")
            yield np.ascontiguousarray(frame[..., ::-1])
    finally:
        capture.release()


def mjpeg_pictures(address: str, timeout_s: float) -> Iterator[Picture]:
    """The pictures of an MJPEG stream over HTTP, as phones and network cameras serve it; ends where it is closed.

    Raises:
        ValueError: nobody answers at the address, or with something else than a stream of pictures.
        StreamBroken: the stream broke off within a picture, fell silent, or sends damaged pictures.
    """
    try:
        response = urllib.request.urlopen(address, timeout=timeout_s)
    except (urllib.error.URLError, OSError, HTTPException, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise ValueError(f"{address} cannot be opened: {reason}") from None
    with response:
        kind = response.headers.get_content_type()
        if kind != "multipart/x-mixed-replace":
            raise ValueError(
                f"{address} answers with {kind}, not with an MJPEG stream (multipart/x-mixed-replace); "
                "IP Webcam's stream is at /video"
            )
        yield from jpeg_parts(response.read1, address, timeout_s)


def _newest(open_source: Callable[[], Iterator[Picture]], timeout_s: float, name: str) -> Iterator[Picture]:
    """Read a live source in a thread of its own and give the newest picture, so that a slow consumer never lags.

    Consumes the source; holds at most one picture; waits for a picture that has not been given yet, at most
    `timeout_s`; stops where the source ends, or when the caller closes it.
    """
    latest: list[Picture] = []
    failure: list[Exception] = []
    changed = threading.Condition()
    ended = threading.Event()

    def read() -> None:
        try:
            for picture in open_source():
                if ended.is_set():
                    return
                with changed:
                    latest[:] = [picture]
                    changed.notify()
        except Exception as error:  # raised again in the consumer's thread
            failure.append(error)
        with changed:
            ended.set()
            changed.notify()

    threading.Thread(target=read, name="camera", daemon=True).start()
    try:
        while True:
            with changed:
                if not changed.wait_for(lambda: bool(latest) or ended.is_set(), 2 * timeout_s):
                    raise StreamBroken(f"{name} gave no picture for {2 * timeout_s:.0f} s")
                if not latest:
                    break
                picture = latest.pop()
            yield picture
    finally:
        ended.set()
    if failure:
        raise failure[0]


def square(picture: Picture, size_px: int) -> UInt8[np.ndarray, "size size 3"]:
    """The picture's middle square, scaled down to the encoder's input (Table A4: phone video to 128 x 128)."""
    height, width = picture.shape[:2]
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    cut = Image.fromarray(picture[top : top + edge, left : left + edge])
    if edge == size_px:
        return np.asarray(cut)
    return np.asarray(
        cut.resize((size_px, size_px), Image.Resampling.BOX if edge > size_px else Image.Resampling.BICUBIC)
    )
