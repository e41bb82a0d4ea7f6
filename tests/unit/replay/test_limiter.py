import math
import random
import threading
import time

import pytest

from slotfilm_dist.replay import codec
from slotfilm_dist.replay.limiter import RateLimiter

DEADLINE_S = 120.0


@pytest.mark.parametrize("updates_per_step", [1.0, 0.1, 0.25, 0.3, 2.0])
def test_ratio_is_exact_to_a_hundredth_in_every_window_of_ten_thousand_steps(updates_per_step):
    rng = random.Random(4)
    limiter = RateLimiter(updates_per_step, min_steps=1000, slack_updates=1, slack_steps=80)
    limiter.start_learning(2000)
    history: list[tuple[int, int]] = []
    bias = 0.5
    while limiter.env_steps < 16_000:
        if rng.random() < 0.01:
            bias = rng.choice([0.02, 0.5, 0.98])  # now one side is fast, now the other
        if rng.random() < bias:
            limiter.try_insert(rng.randint(1, 32))
        else:
            limiter.try_update(rng.randint(1, max(4, int(16 * updates_per_step))))
        if limiter.env_steps >= 2000:
            history.append((limiter.env_steps, limiter.updates))
    start = 0
    for steps, updates in history:
        while history[start + 1][0] <= steps - 10_000:
            start += 1
        if steps - history[start][0] >= 10_000:
            ratio = (updates - history[start][1]) / (steps - history[start][0])
            assert ratio == pytest.approx(updates_per_step, rel=0.01)
    assert start > 10


def test_steps_before_learning_are_never_held_back_and_owe_nothing():
    limiter = RateLimiter(1.0, min_steps=100, slack_updates=0, slack_steps=64)
    assert all(limiter.try_insert(32) for _ in range(100))
    assert limiter.try_insert(100_000)
    assert not limiter.may_update(1)
    limiter.start_learning(103_200)
    assert limiter.updates_owed() == 0
    assert limiter.try_insert(32)
    assert limiter.updates_owed() == 32
    assert [limiter.try_update(1) for _ in range(33)] == [True] * 32 + [False]


def test_no_update_before_min_steps():
    limiter = RateLimiter(1.0, min_steps=100, slack_updates=50, slack_steps=64)
    limiter.start_learning(0)
    assert limiter.try_insert(32)
    assert limiter.try_insert(32)
    assert limiter.try_insert(32)
    assert not limiter.may_update(1)
    assert limiter.try_insert(4)
    assert limiter.may_update(50)
    assert not limiter.may_update(51)


def test_a_tenth_is_a_tenth():
    limiter = RateLimiter(0.1, min_steps=0, slack_updates=0, slack_steps=20)
    limiter.start_learning(0)
    for _ in range(1000):
        assert limiter.try_insert(10)
        assert limiter.updates_owed() == 1
        assert limiter.try_update(1)
        assert not limiter.may_update(1)
    assert limiter.updates == 1000
    assert limiter.ratio == 0.1


def test_workers_may_be_ahead_by_the_slack_and_no_step_more():
    limiter = RateLimiter(2.0, min_steps=0, slack_updates=0, slack_steps=64)
    limiter.start_learning(0)
    assert limiter.try_insert(32)
    assert limiter.try_insert(32)
    assert not limiter.may_insert(1)
    assert limiter.try_update(2)
    assert limiter.may_insert(1)
    assert not limiter.may_insert(2)


def test_asking_counts_nothing():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=4, slack_steps=64)
    limiter.start_learning(0)
    assert limiter.may_insert(8)
    assert limiter.may_update(4)
    assert (limiter.env_steps, limiter.updates) == (0, 0)


def test_requests_that_could_block_each_other_for_ever_are_refused():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=4, slack_steps=30)
    limiter.start_learning(0)
    limiter.may_update(3)
    with pytest.raises(ValueError, match="slack_steps = 30: must be at least 31"):
        limiter.may_insert(32)
    limiter.may_insert(31)
    with pytest.raises(ValueError, match="must be at least 37, or inserts of 31 steps and 10 updates"):
        limiter.may_update(10)


@pytest.mark.parametrize("seed", range(5))
def test_allowed_requests_never_block_each_other(seed):
    rng = random.Random(seed)
    ratio = rng.choice([0.1, 0.37, 1.0, 3.0])
    insert, update = rng.randint(1, 40), rng.randint(1, 10)
    slack_updates = rng.randint(0, update)
    slack_steps = math.ceil(insert + (update - slack_updates) / ratio)
    limiter = RateLimiter(ratio, min_steps=0, slack_updates=slack_updates, slack_steps=slack_steps)
    limiter.start_learning(0)
    for _ in range(500):
        assert limiter.may_insert(insert) or limiter.may_update(update)
        if rng.random() < 0.5:
            limiter.try_insert(rng.randint(1, insert))
        else:
            limiter.try_update(rng.randint(1, update))


def test_wait_ends_after_its_timeout_and_names_what_is_missing():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=0, slack_steps=40)
    before = limiter.await_update(1, timeout_s=0.01)
    assert not before.granted
    assert before.waiting_for == "learning to start; 0 environment steps so far"
    limiter.start_learning(10)
    update = limiter.await_update(4, timeout_s=0.01)
    assert "14 more environment steps" in update.waiting_for
    limiter.try_insert(32)
    limiter.try_insert(16)
    insert = limiter.await_insert(10, timeout_s=0.02)
    assert not insert.granted
    assert "8 more updates" in insert.waiting_for
    assert insert.waited_s >= 0.02
    assert limiter.waited_insert_s >= insert.waited_s
    assert limiter.waited_update_s >= update.waited_s
    assert (limiter.env_steps, limiter.updates) == (48, 0)


def wait_until(condition) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s


def test_progress_of_one_side_wakes_the_other():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=0, slack_steps=48)
    limiter.start_learning(0)
    answers = []
    learner = threading.Thread(target=lambda: answers.append(limiter.await_update(8, DEADLINE_S)))
    learner.start()
    wait_until(lambda: limiter.waiting_updates == 1)
    assert limiter.try_insert(32)
    learner.join(DEADLINE_S)
    worker = threading.Thread(target=lambda: answers.append(limiter.await_insert(32, DEADLINE_S)))
    worker.start()
    wait_until(lambda: limiter.waiting_inserts == 1)
    assert limiter.try_update(16)
    worker.join(DEADLINE_S)
    assert [answer.granted for answer in answers] == [True, True]
    assert (limiter.env_steps, limiter.updates) == (64, 24)
    assert (limiter.waiting_inserts, limiter.waiting_updates) == (0, 0)


def test_closing_sends_waiters_home():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=0, slack_steps=40)
    limiter.start_learning(0)
    answers = []
    learner = threading.Thread(target=lambda: answers.append(limiter.await_update(1, DEADLINE_S)))
    learner.start()
    wait_until(lambda: limiter.waiting_updates == 1)
    limiter.close()
    learner.join(DEADLINE_S)
    assert not learner.is_alive()
    assert not answers[0].granted
    assert answers[0].waiting_for == "nothing: the limiter is closed"
    assert not limiter.try_insert(1)


def test_many_threads_keep_the_bounds_and_lose_no_count():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=8, slack_steps=64)
    limiter.start_learning(0)
    granted = []

    def collect(num_steps: int) -> None:
        for _ in range(200):
            granted.append(limiter.await_insert(num_steps, DEADLINE_S).granted)

    workers = [threading.Thread(target=collect, args=(size,)) for size in (5, 16, 32)]
    for worker in workers:
        worker.start()
    total = 200 * (5 + 16 + 32)
    for _ in range(total // 4):
        assert limiter.await_update(4, DEADLINE_S).granted
        debt = limiter.env_steps - limiter.updates  # steps can only have been added between the two readings
        assert debt <= 64 + 4
    for worker in workers:
        worker.join(DEADLINE_S)
    assert granted == [True] * 600
    assert (limiter.env_steps, limiter.updates) == (total, total)


def test_refund_takes_back_what_did_not_happen():
    limiter = RateLimiter(1.0, min_steps=0, slack_updates=0, slack_steps=64)
    limiter.start_learning(0)
    limiter.try_insert(32)
    limiter.refund_insert(32)
    assert not limiter.may_update(1)
    limiter.try_insert(32)
    limiter.try_update(32)
    limiter.refund_update(2)
    assert limiter.updates_owed() == 2
    with pytest.raises(ValueError, match="num_updates = 31"):
        limiter.refund_update(31)
    with pytest.raises(ValueError, match="num_steps = 33"):
        limiter.refund_insert(33)


def test_fresh_start_after_a_loss_of_data_owes_nothing_and_waits_for_new_steps():
    limiter = RateLimiter(1.0, min_steps=10, slack_updates=2, slack_steps=50)
    limiter.start_learning(0)
    assert limiter.try_insert(40)
    assert limiter.try_update(12)
    limiter.start_learning(40 + 10)
    assert limiter.updates_owed() == 0
    assert not limiter.may_update(1)
    assert limiter.try_insert(10)
    assert limiter.may_update(2)
    assert not limiter.may_update(3)


def test_saved_limiter_goes_on():
    limiter = RateLimiter(0.3, min_steps=10, slack_updates=1, slack_steps=64)
    limiter.start_learning(20)
    for _ in range(4):
        limiter.try_insert(16)
    limiter.try_update(3)
    other = RateLimiter(0.3, min_steps=10, slack_updates=1, slack_steps=64)
    other.load(codec.decode(codec.encode(limiter.save())))
    assert other.save() == limiter.save()
    assert other.updates_owed() == limiter.updates_owed() == int(44 * 0.3 - 3)


def test_state_of_another_ratio_or_incomplete_is_refused():
    limiter = RateLimiter(0.5, min_steps=0, slack_updates=1, slack_steps=64)
    with pytest.raises(ValueError, match="updates_per_step = '1'"):
        limiter.load(RateLimiter(1.0, min_steps=0, slack_updates=1, slack_steps=64).save())
    with pytest.raises(ValueError, match="lacks base_steps"):
        limiter.load({key: value for key, value in limiter.save().items() if key != "base_steps"})


@pytest.mark.parametrize(
    ("field", "value"), [("updates_per_step", 0.0), ("min_steps", -1), ("slack_updates", -1), ("slack_steps", 0)]
)
def test_impossible_settings_are_refused_by_field(field, value):
    settings = {"updates_per_step": 1.0, "min_steps": 0, "slack_updates": 1, "slack_steps": 64}
    with pytest.raises(ValueError, match=field):
        RateLimiter(**settings | {field: value})


def test_the_learners_own_count_makes_skipped_updates_due_again() -> None:
    limiter = RateLimiter(1.0, 0, slack_updates=0, slack_steps=20)
    limiter.start_learning(0)
    limiter.try_insert(10)
    limiter.set_updates(10)
    assert limiter.updates_owed() == 0
    limiter.set_updates(7)
    assert limiter.updates_owed() == 3
    with pytest.raises(ValueError, match="num_updates = -1"):
        limiter.set_updates(-1)
