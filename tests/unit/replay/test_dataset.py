import resource
from dataclasses import replace

import numpy as np
import pytest

from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.replay.shard import ReplayShard

COLUMNS = ("proprio", "goal", "uv", "visible", "action", "reward", "terminated", "truncated", "is_step")


@pytest.fixture
def write(tmp_path, picture_schema, make_block):
    """Write blocks of ten steps in episodes of 25 and finish; gives the directory."""

    def write(num_blocks: int = 12):
        directory = tmp_path / "frames"
        with FrameDatasetWriter(directory, picture_schema, "h1") as writer:
            for i in range(num_blocks):
                writer.append(make_block(10 * i, 10, sequence=i, ends=range(24, 999, 25), schema=picture_schema))
            writer.finish()
        return directory

    return write


def test_finished_dataset_holds_every_row_in_order(write, picture_schema, make_block):
    dataset = open_dataset(write(), "h1")
    blocks = [make_block(10 * i, 10, ends=range(24, 999, 25), schema=picture_schema) for i in range(12)]
    for name in COLUMNS:
        column = getattr(dataset, name)
        np.testing.assert_array_equal(column, np.concatenate([getattr(block, name) for block in blocks]))
        assert column.dtype == getattr(blocks[0], name).dtype
    np.testing.assert_array_equal(dataset.rgb, np.concatenate([block.visual for block in blocks]))
    assert isinstance(dataset.rgb, np.memmap)
    assert dataset.schema == picture_schema
    assert (dataset.num_steps, dataset.num_rows) == (120, sum(block.num_rows for block in blocks))


def test_columns_are_plain_npy_files(write):
    directory = write()
    assert np.load(directory / "rgb.npy").shape[1:] == (4, 4, 3)
    assert np.load(directory / "reward.npy").ndim == 1


def test_episode_number_follows_the_episode_across_blocks(write):
    dataset = open_dataset(write(), "h1")
    steps = dataset.is_step
    np.testing.assert_array_equal(dataset.episode[steps], (dataset.reward[steps] / 10).astype(int) // 25)
    assert dataset.num_episodes == 5


def test_episodes_of_several_environments_in_one_block_stay_apart(tmp_path, picture_schema, make_block):
    """Two lanes a block: steps from 0 and steps from 5000, cut at different times."""
    ends = [14, 29, 5006, 5031]
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        for i in range(4):
            lanes = [make_block(first + 10 * i, 10, ends=ends, schema=picture_schema) for first in (0, 5000)]
            columns = {name: np.concatenate([getattr(lane, name) for lane in lanes]) for name in (*COLUMNS, "visual")}
            writer.append(replace(lanes[0], sequence=i, **columns))
        writer.finish()
    dataset = open_dataset(tmp_path, "h")
    step = (dataset.reward[dataset.is_step] / 10).astype(int)
    expected = np.searchsorted([15, 30, 5000, 5007, 5032], step, side="right")
    pairs = set(zip(expected.tolist(), dataset.episode[dataset.is_step].tolist(), strict=True))
    assert len(pairs) == 6
    assert len({episode for _, episode in pairs}) == dataset.num_episodes == 6


def test_restarted_worker_begins_new_episodes(tmp_path, picture_schema, make_block):
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        writer.append(make_block(0, 10, schema=picture_schema))
        writer.append(make_block(10, 10, incarnation=1, schema=picture_schema))
        writer.finish()
    assert open_dataset(tmp_path, "h").num_episodes == 2


@pytest.mark.parametrize("rows", [1, 5, 11, 12, 30, 10_000])
def test_blocks_give_back_every_row_and_fill_replay(write, picture_schema, rows):
    dataset = open_dataset(write(), "h1")
    blocks = list(dataset.blocks(rows))
    np.testing.assert_array_equal(np.concatenate([block.visual for block in blocks]), dataset.rgb)
    np.testing.assert_array_equal(np.concatenate([block.reward for block in blocks]), dataset.reward)
    assert all(block.num_rows <= max(rows, 11) for block in blocks)
    assert len(blocks) == {1: 14, 5: 14, 11: 14, 12: 12, 30: 5, 10_000: 1}[rows]
    shard = ReplayShard(picture_schema, 1000, 0)
    assert all(shard.insert(block) for block in blocks)
    assert shard.num_steps() == 120
    (batch,) = shard.sample(1, 200)
    np.testing.assert_array_equal(batch.proprio[:, 0], batch.reward / 10)


def test_unfinished_dataset_is_never_taken_for_a_finished_one(tmp_path, picture_schema, make_block):
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        writer.append(make_block(0, 10, schema=picture_schema))
    with pytest.raises(ValueError, match="is an unfinished dataset; collect again to continue"):
        open_dataset(tmp_path, "h")


def test_interrupted_writer_is_continued_from_its_last_commit(tmp_path, picture_schema, make_block):
    blocks = [
        make_block(10 * i, 10, sequence=i, ends=range(24, 999, 25), schema=picture_schema, incarnation=i // 5)
        for i in range(12)
    ]
    with FrameDatasetWriter(tmp_path, picture_schema, "h", commit_rows=30) as writer:
        for block in blocks[:5]:
            writer.append(block)
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        assert writer.num_steps == 30  # the last two blocks were never committed
        assert writer.num_episodes == 2
        for block in blocks[5:]:
            writer.append(block)
        writer.finish()
    dataset = open_dataset(tmp_path, "h")
    expected = blocks[:3] + blocks[5:]
    np.testing.assert_array_equal(dataset.reward, np.concatenate([block.reward for block in expected]))
    np.testing.assert_array_equal(dataset.rgb, np.concatenate([block.visual for block in expected]))
    assert dataset.num_steps == 100
    assert dataset.num_episodes == len(np.unique(dataset.episode))


def test_rows_that_were_never_committed_are_cut_off(tmp_path, picture_schema, make_block):
    with FrameDatasetWriter(tmp_path, picture_schema, "h", commit_rows=10) as writer:
        writer.append(make_block(0, 20, schema=picture_schema))
        writer.append(make_block(20, 8, sequence=1, schema=picture_schema))
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        writer.finish()
    np.testing.assert_array_equal(open_dataset(tmp_path, "h").proprio[:, 0], np.arange(21))
    assert (tmp_path / "truncated.npy").stat().st_size == 256 + 21


def test_episode_that_ends_as_the_next_one_begins_stays_apart(tmp_path, picture_schema, make_block):
    first = make_block(0, 10, ends=[9], schema=picture_schema)
    second = make_block(10, 10, sequence=1, schema=picture_schema)
    for name in ("visual", "proprio", "goal"):
        getattr(second, name)[0] = getattr(first, name)[-1]
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        writer.append(first)
        writer.append(second)
        writer.finish()
    assert open_dataset(tmp_path, "h").num_episodes == 2


def test_writer_that_failed_while_finishing_is_continued(tmp_path, picture_schema, make_block):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1200, hard))  # the columns fit, the manifest does not
    try:
        with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
            writer.append(make_block(0, 10, schema=picture_schema))
            with pytest.raises(OSError, match="too large"):
                writer.finish()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with pytest.raises(ValueError, match="is an unfinished dataset"):
        open_dataset(tmp_path, "h")
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        assert writer.num_steps == 10
        writer.append(make_block(10, 10, incarnation=1, schema=picture_schema))
        writer.finish()
    dataset = open_dataset(tmp_path, "h")
    np.testing.assert_array_equal(dataset.reward[dataset.is_step], 10 * np.arange(20))


def test_full_disk_while_appending_costs_no_committed_row(tmp_path, picture_schema, make_block):
    def fill(writer: FrameDatasetWriter) -> None:
        for i in range(1000):
            writer.append(make_block(10 * i, 10, sequence=i, schema=picture_schema))

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        writer = FrameDatasetWriter(tmp_path, picture_schema, "h", commit_rows=100)
        with pytest.raises(OSError, match="too large"), writer:
            fill(writer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer:
        assert writer.num_steps >= 800
        kept = writer.num_steps
        writer.finish()
    dataset = open_dataset(tmp_path, "h")
    np.testing.assert_array_equal(dataset.reward[dataset.is_step], 10 * np.arange(kept))


def test_finished_dataset_is_not_written_to(write, picture_schema):
    directory = write()
    with pytest.raises(ValueError, match="is a finished dataset"):
        FrameDatasetWriter(directory, picture_schema, "h1")


def test_unfinished_dataset_of_another_config_is_not_continued(tmp_path, picture_schema):
    FrameDatasetWriter(tmp_path, picture_schema, "h").close()
    with pytest.raises(ValueError, match="of another config or schema"):
        FrameDatasetWriter(tmp_path, picture_schema, "other")
    with pytest.raises(ValueError, match="of another config or schema"):
        FrameDatasetWriter(tmp_path, replace(picture_schema, proprio_dim=9), "h")


def test_dataset_of_another_config_is_refused(write):
    with pytest.raises(ValueError, match="made with config h1, this run needs h2"):
        open_dataset(write(), "h2")


def test_damaged_column_is_named(write):
    directory = write()
    path = directory / "action.npy"
    content = path.read_bytes()
    path.write_bytes(content[:-3] + bytes([content[-3] ^ 4]) + content[-2:])
    with pytest.raises(ValueError, match=r"action\.npy is corrupt"):
        open_dataset(directory, "h1")
    open_dataset(directory, "h1", verify=False)
    path.write_bytes(content[:-8])
    with pytest.raises(ValueError, match=r"action\.npy has"):
        open_dataset(directory, "h1", verify=False)
    path.unlink()
    with pytest.raises(ValueError, match=r"action\.npy is missing"):
        open_dataset(directory, "h1", verify=False)


def test_broken_manifest_is_named(write):
    directory = write()
    for content in (b"{", b"[]", b'{"format": 99}'):
        (directory / "manifest.json").write_bytes(content)
        with pytest.raises(ValueError, match=r"manifest\.json is"):
            open_dataset(directory, "h1")


def test_missing_dataset_is_named(tmp_path):
    with pytest.raises(ValueError, match="is not a dataset"):
        open_dataset(tmp_path, "h")


def test_dataset_without_a_camera_works(tmp_path, picture_schema, make_block):
    blind = replace(picture_schema, visual_kind="none", visual_shape=(0,))
    block = make_block(0, 10, schema=picture_schema)
    with FrameDatasetWriter(tmp_path, blind, "h") as writer:
        writer.append(replace(block, visual=np.zeros((11, 0), np.float32)))
        writer.finish()
    dataset = open_dataset(tmp_path, "h")
    assert dataset.rgb.shape == (11, 0)
    assert [block.num_steps for block in dataset.blocks(100)] == [10]


def test_tokens_and_missing_labels_are_refused(tmp_path, schema, picture_schema):
    with pytest.raises(ValueError, match=r"schema\.visual_kind"):
        FrameDatasetWriter(tmp_path, schema, "h")
    with pytest.raises(ValueError, match=r"schema\.store_labels"):
        FrameDatasetWriter(tmp_path, replace(picture_schema, store_labels=False), "h")


def test_empty_dataset_cannot_be_finished(tmp_path, picture_schema):
    with FrameDatasetWriter(tmp_path, picture_schema, "h") as writer, pytest.raises(ValueError, match="num_rows"):
        writer.finish()


@pytest.fixture
def input_schema(picture_schema):
    return replace(picture_schema, num_reward_inputs=3)


@pytest.fixture
def with_inputs(make_block, input_schema):
    """A block of steps k whose reward's inputs are k, k + 1, k + 2, also in the rows without a step."""

    def with_inputs(first_step: int, num_steps: int, **values):
        block = make_block(first_step, num_steps, schema=input_schema, **values)
        inputs = block.proprio[:, :1] + np.arange(3, dtype=np.float32)
        return replace(block, reward_inputs=inputs)

    return with_inputs


def test_dataset_with_the_rewards_inputs_gives_each_reader_the_reward_it_computes(tmp_path, input_schema, with_inputs):
    with FrameDatasetWriter(tmp_path, input_schema, "h") as writer:
        for i in range(4):
            writer.append(with_inputs(10 * i, 10, sequence=i))
        writer.finish()
    assert not (tmp_path / "reward.npy").exists()
    dataset = open_dataset(tmp_path, "h")
    assert dataset.reward is None
    for factor in (1, -2):
        for block in dataset.blocks(25, lambda inputs, factor=factor: factor * inputs.sum(axis=1)):
            expected = np.where(block.is_step, factor * (3 * block.proprio[:, 0] + 3), 0)
            np.testing.assert_array_equal(block.reward, expected)
            assert block.reward.dtype == np.float32
    with pytest.raises(ValueError, match="reward_of"):
        next(dataset.blocks(25))


def test_stored_reward_is_not_computed_anew(write):
    dataset = open_dataset(write(), "h1")
    rewards = np.concatenate([block.reward for block in dataset.blocks(25, lambda inputs: inputs.sum(axis=1))])
    np.testing.assert_array_equal(rewards, dataset.reward)


@pytest.mark.parametrize(
    ("inputs", "complaint"),
    [
        (None, r"reward_inputs: missing, expected \(11, 3\)"),
        (np.zeros((11, 2), np.float32), r"reward_inputs: shape \(11, 2\)"),
        (np.full((11, 3), np.nan, np.float32), "reward_inputs: not finite in row 0"),
    ],
)
def test_block_without_fitting_inputs_is_refused(tmp_path, input_schema, make_block, altered, inputs, complaint):
    block = altered(make_block(0, 10, schema=input_schema), reward_inputs=inputs)
    with FrameDatasetWriter(tmp_path, input_schema, "h") as writer, pytest.raises(ValueError, match=complaint):
        writer.append(block)


def test_dataset_of_an_older_layout_is_refused_with_what_to_do(write):
    directory = write()
    path = directory / "manifest.json"
    path.write_text(path.read_text().replace('"format": 2', '"format": 1'))
    with pytest.raises(ValueError, match="format 2; delete the directory and collect again"):
        open_dataset(directory, "h1")
