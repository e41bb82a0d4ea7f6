import dataclasses

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from slotfilm_dist.evaluation.video import (
    OBJECT_COLORS,
    SLOT_COLORS,
    RolloutFrame,
    attention_overlay,
    draw_frame,
    write_film_strip,
    write_video,
)


def make_frame(*, slots=2, success=False, visible=(True, True), seed=0):
    """A grey picture; slot 0 attends to the top left token, slot 1 to the bottom right one."""
    attention = np.zeros((slots, 64), dtype=np.float32)
    for slot in range(slots):
        attention[slot, 0 if slot == 0 else 63] = 1.0
    return RolloutFrame(
        rgb=np.full((64, 64, 3), 90 + seed % 100, dtype=np.uint8),
        attention=attention,
        uv_predicted=np.array([[0.25, 0.25], [0.75, 0.25]], dtype=np.float32)[:slots],
        uv=np.array([[0.25, 0.75], [0.75, 0.75]], dtype=np.float32),
        visible=np.array(visible),
        reward=0.5,
        success=success,
    )


def draw(frame, **changes):
    return draw_frame(frame, **({"step": 0, "num_steps": 10, "episode_return": 0.5, "panel_px": 128} | changes))


def has_color(picture, color):
    return bool((np.abs(picture.astype(int) - color).max(axis=-1) < 8).any())


def test_heat_map_glows_where_the_slot_attends():
    frame = make_frame()
    heat = attention_overlay(frame.rgb, frame.attention[0], 64, alpha=1.0).astype(int).sum(axis=-1)
    assert heat[:4, :4].mean() > 500
    assert heat[32:, 32:].max() < 10


def test_transparent_heat_map_is_the_picture():
    frame = make_frame()
    assert (attention_overlay(frame.rgb, frame.attention[0], 64, alpha=0.0) == frame.rgb).all()


def test_tokens_that_are_no_square_grid_are_refused():
    with pytest.raises(ValueError, match="60 tokens"):
        attention_overlay(make_frame().rgb, np.zeros(60, dtype=np.float32), 64)


def test_predictions_and_truth_are_drawn_at_their_places():
    picture = draw(make_frame())
    panel = picture[60 : 60 + 128, 8 : 8 + 128]
    assert has_color(panel[20:44, 20:44], SLOT_COLORS[0])
    assert has_color(panel[20:44, 84:108], SLOT_COLORS[1])
    assert has_color(panel[84:108, 20:44], OBJECT_COLORS[0])
    assert has_color(panel[84:108, 84:108], OBJECT_COLORS[1])


def test_object_out_of_view_is_not_drawn():
    panel = draw(make_frame(visible=(True, False)))[60 : 60 + 128, 8 : 8 + 128]
    assert has_color(panel, OBJECT_COLORS[0])
    assert not has_color(panel, OBJECT_COLORS[1])


@pytest.mark.parametrize("slots", [0, 1, 2, 4])
@pytest.mark.parametrize("panel_px", [127, 128])
def test_edges_are_even_for_any_number_of_slots(slots, panel_px):
    frame = dataclasses.replace(make_frame(slots=slots), uv_predicted=np.zeros((slots, 2), dtype=np.float32))
    picture = draw(frame, panel_px=panel_px)
    assert (picture.shape[0] % 2, picture.shape[1] % 2) == (0, 0)
    assert picture.shape[1] >= (slots + 1) * panel_px


def test_score_strip_changes_with_step_reward_and_success():
    frame = make_frame()
    pictures = [
        draw(frame),
        draw(frame, step=5),
        draw(dataclasses.replace(frame, reward=0.9)),
        draw(dataclasses.replace(frame, success=True)),
    ]
    strips = {picture[:36].tobytes() for picture in pictures}
    assert len(strips) == len(pictures)
    assert all((picture[36:] == pictures[0][36:]).all() for picture in pictures)


def test_video_reads_back_with_all_frames_size_and_pixel_format(tmp_path):
    frames = [make_frame(seed=i, success=i > 5) for i in range(12)]
    path = write_video(frames, tmp_path / "videos" / "a.mp4", fps=10, panel_px=96)
    with imageio.get_reader(path) as reader:
        described = reader.get_meta_data()
        pictures = [np.asarray(picture) for picture in reader]
    assert len(pictures) == 12
    assert described["codec"] == "h264"
    assert described["pix_fmt"].startswith("yuv420p")
    assert described["fps"] == 10
    assert pictures[0].shape == draw(frames[0], panel_px=96).shape
    assert np.abs(pictures[3][96, 30].astype(int) - 93).max() < 8
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]


def test_large_video_is_compressed_harder(tmp_path):
    rng = np.random.default_rng(0)
    frames = [
        dataclasses.replace(make_frame(slots=0), rgb=rng.integers(0, 255, (64, 64, 3), dtype=np.uint8))
        for _ in range(12)
    ]
    free = write_video(frames, tmp_path / "free.mp4", panel_px=96, max_bytes=10**9).stat().st_size
    small = write_video(frames, tmp_path / "small.mp4", panel_px=96, max_bytes=free // 2).stat().st_size
    assert small <= free // 2


def test_video_without_frames_or_of_another_type_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one step"):
        write_video([], tmp_path / "a.mp4")
    with pytest.raises(ValueError, match=r"must end in \.mp4"):
        write_video([make_frame()], tmp_path / "a.gif")


def test_film_strip_shows_first_middle_and_last_picture(tmp_path):
    frames = [make_frame(seed=10 * i) for i in range(9)]
    path = write_film_strip(frames, tmp_path / "strip.png", num_frames=3, panel_px=50)
    strip = np.asarray(Image.open(path))
    assert strip.shape[1] == 3 * 50 + 2 * 4
    assert [int(strip[25, left + 25, 0]) for left in (0, 54, 108)] == [90, 130, 170]


def test_film_strip_of_a_short_episode_repeats_no_picture(tmp_path):
    path = write_film_strip([make_frame(), make_frame()], tmp_path / "strip.png", num_frames=6, panel_px=50)
    assert Image.open(path).width == 2 * 50 + 4
