"""Threads of small work: as many as help, and fewer beside a GPU."""

import threading

from visthrow.diagnose import threads


def test_fewer_threads_work_beside_a_gpu(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 16)
    monkeypatch.setattr(threads, "_aside", threading.Event())

    def working() -> int:
        waiting, most, lock = [0], [0], threading.Lock()
        meet = threading.Event()

        def work(_: int) -> None:
            with lock:
                waiting[0] += 1
                most[0] = max(most[0], waiting[0])
            meet.wait(0.02)  # long enough for all others to come
            with lock:
                waiting[0] -= 1

        threads.each(work, range(16))
        return most[0]

    assert working() == threads.MOST
    threads.aside()
    assert working() == threads.MOST_ASIDE
