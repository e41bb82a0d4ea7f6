"""Splits an MJPEG stream (multipart/x-mixed-replace) into pictures."""

import io
from collections.abc import Callable, Iterator
from http.client import HTTPException, IncompleteRead

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

_START, _END = b"\xff\xd8", b"\xff\xd9"
_READ_BYTES = 1 << 16
_MAX_PICTURE_BYTES = 32 << 20
_MAX_DAMAGED = 10


class StreamBroken(RuntimeError):
    """The stream stopped being one of pictures."""


def jpeg_parts(
    read: Callable[[int], bytes], name: str, timeout_s: float
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The pictures of a stream, found by the marks that begin and end every JPEG; cameras differ in their headers.

    A damaged picture is skipped, ten in a row are not.

    Args:
        read: reads at most so many bytes, an empty result at the end.
        name: of the stream, for messages.
        timeout_s: after which `read` gives up, for messages.

    Raises:
        StreamBroken: it ended within a picture, fell silent, or is no stream of JPEGs.
    """
    buffer = bytearray()
    num_pictures = num_damaged = 0
    while True:
        try:
            chunk = read(_READ_BYTES)
        except TimeoutError:
            raise StreamBroken(f"{name} sent nothing for {timeout_s:g} s, after {num_pictures} pictures") from None
        except (OSError, IncompleteRead, HTTPException) as error:
            raise StreamBroken(f"{name} broke off after {num_pictures} pictures: {error}") from None
        if not chunk:
            if _START in buffer:
                raise StreamBroken(f"{name} broke off within a picture, after {num_pictures} whole ones")
            return
        buffer += chunk
        for jpeg in _whole_pictures(buffer):
            try:
                with Image.open(io.BytesIO(jpeg)) as image:
                    picture = np.asarray(image.convert("RGB"))
            except (UnidentifiedImageError, OSError):
                num_damaged += 1
                if num_damaged >= _MAX_DAMAGED:
                    raise StreamBroken(f"{name} sent {num_damaged} damaged pictures in a row") from None
                continue
            num_damaged = 0
            num_pictures += 1
            yield picture
        if len(buffer) > _MAX_PICTURE_BYTES:
            raise StreamBroken(f"{name} sent {len(buffer)} bytes without the end of a picture: no MJPEG stream")


def _whole_pictures(buffer: bytearray) -> Iterator[bytes]:
    """Take every complete JPEG out of the buffer; what came before it is dropped.

    Within a JPEG's compressed data the byte 0xFF is followed by 0 or by a restart mark, so the end mark found after
    the start mark is the picture's own, but for a thumbnail in its header, which cameras do not send.
    """
    while True:
        start = buffer.find(_START)
        if start < 0:
            del buffer[:-1]  # a start mark may lie across two chunks
            return
        end = buffer.find(_END, start + len(_START))
        if end < 0:
            del buffer[:start]
            return
        yield bytes(buffer[start : end + len(_END)])
        del buffer[: end + len(_END)]
