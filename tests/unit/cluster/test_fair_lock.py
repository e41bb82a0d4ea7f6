"""Who gets the lock between the updates of a busy loop."""

import threading
import time

import pytest

from slotfilm_dist.cluster.fair_lock import FairLock


def test_whoever_waits_gets_it_before_the_one_that_releases_it_and_asks_again() -> None:
    lock, order = FairLock(), []

    def look() -> None:
        with lock:
            order.append("who waits")

    waiter = threading.Thread(target=look)
    with lock:
        waiter.start()
        while not lock._turn.locked():
            time.sleep(0.001)
    with lock:
        order.append("who asks again")
    waiter.join()
    assert order == ["who waits", "who asks again"]


def test_error_inside_gives_it_back() -> None:
    lock = FairLock()
    with pytest.raises(OSError, match="full"), lock:
        raise OSError("full")
    with lock:
        pass
