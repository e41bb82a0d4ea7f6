"""Pictures from files and from a stream on the loopback, whole or broken, and `slotfilm perceive` on them."""

import contextlib
import csv
import dataclasses
import io
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from slotfilm_dist.__main__ import main
from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.camera_sources import mjpeg_pictures, pictures, square
from slotfilm_dist.evaluation.mjpeg import StreamBroken, jpeg_parts
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant

Write = Callable[[bytes], object]


def grey(level: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def jpeg(level: int) -> bytes:
    out = io.BytesIO()
    Image.fromarray(grey(level)).save(out, "JPEG", quality=95)
    return out.getvalue()


def part(content: bytes) -> bytes:
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
    return head.encode() + content + b"\r\n"


@contextlib.contextmanager
def serving(send: Callable[[Write], None], kind: str = "multipart/x-mixed-replace; boundary=frame") -> Iterator[str]:
    """A camera on the loopback; gives its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.end_headers()
            with contextlib.suppress(OSError):
                send(self.wfile.write)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/video"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def levels(stream: Iterator[np.ndarray]) -> list[int]:
    return [int(picture[10, 10, 0]) for picture in stream]


def test_stream_gives_every_picture_in_order_and_ends_where_it_is_closed() -> None:
    with serving(lambda write: [write(part(jpeg(level))) for level in (10, 80, 200)] and None) as address:
        assert levels(mjpeg_pictures(address, 5.0)) == pytest.approx([10, 80, 200], abs=2)


def test_slow_reader_of_a_live_source_gets_the_newest_picture() -> None:
    first_read, sent = threading.Event(), threading.Event()

    def send(write: Write) -> None:
        write(part(jpeg(5)))
        first_read.wait(20)
        for level in range(10, 250, 5):
            write(part(jpeg(level)))
        sent.set()

    others = set(threading.enumerate())
    with serving(send) as address:
        stream = pictures(address, 5.0)
        first = int(next(stream)[10, 10, 0])
        (reader,) = (thread for thread in {*threading.enumerate()} - others if thread.name == "camera")
        first_read.set()
        assert sent.wait(20)
        reader.join(20)
        assert not reader.is_alive()
        assert [first, *levels(stream)] == pytest.approx([5, 245], abs=2)


def test_stream_that_falls_silent_is_named_after_the_timeout() -> None:
    released = threading.Event()

    def send(write: Write) -> None:
        write(part(jpeg(50)))
        released.wait(20)

    with serving(send) as address:
        stream = pictures(address, 2.0)
        assert int(next(stream)[0, 0, 0]) == pytest.approx(50, abs=2)
        with pytest.raises(StreamBroken, match=r"sent nothing for 2 s, after 1 pictures"):
            next(stream)
        released.set()


def test_stream_that_ends_within_a_picture_is_broken() -> None:
    with serving(lambda write: write(part(jpeg(50)) + part(jpeg(60))[:200]) and None) as address:
        stream = mjpeg_pictures(address, 5.0)
        next(stream)
        with pytest.raises(StreamBroken, match="within a picture, after 1 whole"):
            next(stream)


def test_address_without_a_stream_is_refused() -> None:
    with serving(lambda write: write(b"<html>") and None, kind="text/html") as address:
        with pytest.raises(ValueError, match="answers with text/html"):
            next(pictures(address, 5.0))
        closed = address
    with pytest.raises(ValueError, match="cannot be opened"):
        next(pictures(closed, 5.0))


def chunks(content: bytes, size: int) -> Callable[[int], bytes]:
    parts = iter([content[i : i + size] for i in range(0, len(content), size)])
    return lambda _: next(parts, b"")


@pytest.mark.parametrize("size", [1, 7, 1000, 1 << 20])
def test_pictures_are_found_however_the_stream_is_cut(size: int) -> None:
    content = part(jpeg(20)) + b"\xff" + part(jpeg(120)) + part(jpeg(220))
    assert levels(jpeg_parts(chunks(content, size), "camera", 1.0)) == pytest.approx([20, 120, 220], abs=2)


def test_damaged_picture_is_skipped_and_ten_in_a_row_are_not() -> None:
    damaged = part(b"\xff\xd8 no picture \xff\xd9")
    content = part(jpeg(20)) + 3 * damaged + part(jpeg(120))
    assert levels(jpeg_parts(chunks(content, 500), "camera", 1.0)) == pytest.approx([20, 120], abs=2)
    with pytest.raises(StreamBroken, match="10 damaged pictures"):
        levels(jpeg_parts(chunks(part(jpeg(20)) + 10 * damaged, 500), "camera", 1.0))


def test_endless_bytes_without_a_picture_do_not_fill_the_memory() -> None:
    sent = 0

    def read(_: int) -> bytes:
        nonlocal sent
        sent += 1 << 20
        return b"\xff\xd8" + bytes(1 << 20)

    with pytest.raises(StreamBroken, match="without the end of a picture"):
        next(jpeg_parts(read, "camera", 1.0))
    assert sent < 100 << 20


def test_image_folder_and_video_files(tmp_path: Path) -> None:
    for level in (200, 100):
        Image.fromarray(grey(level)).save(tmp_path / f"{level}.png")
    (tmp_path / "notes.txt").write_text("no picture")
    assert levels(pictures(str(tmp_path), 1.0)) == [100, 200]
    assert levels(pictures(str(tmp_path / "200.png"), 1.0)) == [200]
    Image.fromarray(grey(90)[..., 0]).save(tmp_path / "grey.png")
    assert next(pictures(str(tmp_path / "grey.png"), 1.0)).shape == (48, 64, 3)
    video = tmp_path / "clip.mp4"
    imageio.mimwrite(video, [grey(level) for level in (40, 120, 220)], fps=10, macro_block_size=2)
    assert levels(pictures(str(video), 1.0)) == pytest.approx([40, 120, 220], abs=4)


def test_what_is_no_source_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.png").write_text("no picture")
    (tmp_path / "a.mp4").write_text("no video")
    for source, part_of in (
        ("nowhere", "does not exist"),
        ("empty", "holds no image"),
        ("a.png", "as an image"),
        ("a.mp4", "as a video"),
    ):
        with pytest.raises(ValueError, match=part_of):
            next(pictures(str(tmp_path / source), 1.0))


def test_middle_square_keeps_proportions() -> None:
    picture = np.zeros((90, 160, 3), np.uint8)
    picture[:, 35:125] = 255  # exactly the middle square
    assert (square(picture, 30) == 255).all()
    assert square(picture, 30).shape == (30, 30, 3)
    assert (square(picture.transpose(1, 0, 2).copy(), 128) == 255).all()
    small = np.random.default_rng(0).integers(0, 255, (30, 30, 3), dtype=np.uint8)
    assert (square(small, 30) == small).all()


def small(variant: str) -> RunConfig:
    base = apply_variant(variant, smoke())
    return dataclasses.replace(
        base,
        env=dataclasses.replace(base.env, image_size=32),
        runtime=dataclasses.replace(base.runtime, learner_threads=1, device="cpu"),
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, write_agent_run: Callable[..., Path]) -> Path:
    return write_agent_run(tmp_path_factory.mktemp("runs") / "run", small("slotfilm"))


def test_perceiving_a_video_writes_a_video_and_its_numbers(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, out = tmp_path / "in.mp4", tmp_path / "out.mp4"
    imageio.mimwrite(video, [grey(level) for level in range(0, 250, 25)], fps=10, macro_block_size=2)
    assert main(["perceive", str(video), "--checkpoint", str(run), "--out", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["pictures"] == 10
    assert summary["rate_hz"] > 0
    with imageio.get_reader(out) as reader:
        drawn = [np.asarray(frame) for frame in reader]
    assert len(drawn) == 10
    assert drawn[0].shape[1] == 3 * 256 + 4 * 8  # the picture and two slots
    assert abs(int(drawn[9][150, 50, 0]) - 225) < 12  # the last picture is the brightest one
    with out.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["picture"]) for row in rows] == list(range(10))
    for name in ("in_view_banana", "in_view_bowl", "slot_0_u", "slot_1_v", "slot_1_peak"):
        assert all(0 <= float(row[name]) <= 1 for row in rows)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.mp4", "out.csv", "out.mp4"]


def test_perceiving_a_stream_stops_when_told(run: Path, tmp_path: Path) -> None:
    def send(write: Write) -> None:
        while True:
            write(part(jpeg(120)))

    with serving(send) as address:
        words = ["perceive", address, "--checkpoint", str(run), "--out", str(tmp_path / "o"), "--max-frames", "4"]
        assert main(words) == 0
    names = sorted(path.name for path in (tmp_path / "o").iterdir())
    assert names == ["000000.png", "000001.png", "000002.png", "000003.png", "numbers.csv"]


def test_broken_stream_keeps_what_was_seen_and_says_why(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(lambda write: write(part(jpeg(50)) + part(jpeg(60))[:200]) and None) as address:
        out = tmp_path / "o.mp4"
        assert main(["perceive", address, "--checkpoint", str(run), "--out", str(out), "--json"]) == 1
    told = capsys.readouterr()
    assert "broke off within a picture" in told.err
    assert "Traceback" not in told.err
    summary = json.loads(told.out)
    assert "broke off" in summary["broken"]
    assert out.exists() == (summary.get("pictures", 0) > 0)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--out", "o.gif"), r".gif cannot be written"),
        ((), "nothing to do"),
        (("--out", "o.png", "--timeout", "0"), "--timeout"),
        (("--out", "o.png", "--max-frames", "0"), "--max-frames 0"),
        (("--out", "o.png", "--which", "best"), "use the newest checkpoint, last"),
        (("--out", "o.png", "--which", "pretrained", "--artifacts", "none"), "encoder-"),
    ],
)
def test_mistakes_are_named(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], named: str
) -> None:
    Image.fromarray(grey(9)).save(tmp_path / "a.png")
    changed = [str(tmp_path / word) if word.startswith("o.") else word for word in words]
    assert main(["perceive", str(tmp_path / "a.png"), "--checkpoint", str(run), *changed]) == 2
    assert named in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_agent_without_slots_cannot_perceive(
    tmp_path: Path, write_agent_run: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    blind = write_agent_run(tmp_path / "blind", small("state_only"))
    Image.fromarray(grey(9)).save(tmp_path / "a.png")
    words = ["perceive", str(tmp_path / "a.png"), "--checkpoint", str(blind), "--out", str(tmp_path / "o.png")]
    assert main(words) == 2
    assert "'state_only' has no slots" in capsys.readouterr().err


def test_one_webcam_number_that_is_none_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["perceive", "97", "--checkpoint", str(run), "--out", str(tmp_path / "o.png")]
    assert main(words) == 2
    assert "webcam 97 cannot be opened" in capsys.readouterr().err
