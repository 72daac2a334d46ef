"""What the worker has to solve: in order, never for long in the loop's way, and tidied up after."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from time import perf_counter, sleep

import numpy as np
import pytest

from fakes import FakeClock, HeldExecutor, InlineExecutor
from soilbus.daemon.work_queue import WorkQueue


def test_results_come_in_their_order_with_their_ends():
    worker = HeldExecutor()
    queue = WorkQueue(worker, lambda task: f"result of {task}", 5.0)
    assert [queue.add(task, 10.0 + task, 7, 10.5 + task) for task in (0, 1)] == [0, 0]
    assert list(queue.results(12.0)) == []
    assert queue.solving_since == 10.5
    worker.do_next()
    assert queue.has_result
    ((result, pending),) = queue.results(13.0)
    assert (result, pending.at, pending.epoch) == ("result of 0", 10.0, 7)
    assert queue.solving_since == 13.0
    worker.do_next()
    assert [result for result, _ in queue.results(14.0)] == ["result of 1"]
    assert not queue
    assert queue.solving_since is None
    assert queue.solved == 2


def test_what_the_worker_cannot_keep_up_with_is_dropped_but_for_the_newest_and_the_one_it_has():
    worker = HeldExecutor()
    queue = WorkQueue(worker, lambda task: task, 0.0)
    worker_has = queue.add(0, 0.0, 0, 0.0)
    worker.held[0][0].set_running_or_notify_cancel()
    dropped = [queue.add(task, 0.0, 0, 0.0) for task in range(1, 12)]
    waiting = 12 - sum(dropped)
    assert 2 <= waiting <= 4  # a window older than a few hops is of no use any more
    assert [worker_has, *dropped] == [0] * waiting + [1] * (12 - waiting)
    worker.held[0][0].set_result(0)
    del worker.held[0]
    while worker.held:
        if worker.held[0][0].cancelled():
            del worker.held[0]
        else:
            worker.do_next()
    assert [result for result, _ in queue.results(1.0)] == [0, *range(13 - waiting, 12)]


@pytest.mark.parametrize(("solved", "waited"), [(False, 0.04), (True, 0.0)])
def test_the_loop_waits_for_a_result_and_no_longer(solved, waited):
    clock, worker = FakeClock(), HeldExecutor()
    queue = WorkQueue(worker, lambda task: task, clock(), clock.wait_for)
    queue.wait(0.04)
    assert clock() == 1000.0  # for nothing
    queue.add(0, clock(), 0, clock())
    if solved:
        worker.do_next()
    queue.wait(0.04)
    queue.wait(-0.01)
    assert clock() - 1000.0 == pytest.approx(waited)


def test_a_real_result_ends_the_wait():
    with ThreadPoolExecutor(max_workers=1) as worker:
        queue = WorkQueue(worker, lambda task: sleep(0.01), 0.0)
        queue.add(0, 0.0, 0, 0.0)
        begin = perf_counter()
        queue.wait(60.0)
        assert perf_counter() - begin < 30.0
        assert queue.has_result


def test_free_memory_is_given_back_once_in_a_while_and_after_the_result_is_out(monkeypatch):
    done: list[str] = []
    monkeypatch.setattr("soilbus.daemon.work_queue.give_back_freed_memory", partial(done.append, "tidy"))
    queue = WorkQueue(InlineExecutor(), lambda task: task, 0.0)
    for task in range(300):
        queue.add(task, 0.0, 0, 0.0)
        for result, _ in queue.results(0.0):
            done.append(f"window {result} out")
    tidied = [i for i, what in enumerate(done) if what == "tidy"]
    after = [int(done[i - 1].split()[1]) for i in tidied]
    gaps = np.diff([0, *after, 299])
    assert max(gaps) <= 120  # of windows of a second: every other minute at least
    assert min(gaps[:-1]) >= 30  # it costs time, too
    assert [done[i - 1] for i in tidied] == [f"window {window} out" for window in after]
