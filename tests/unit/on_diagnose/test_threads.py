"""Threads of small work: as many as help, and fewer beside a GPU."""

import threading

from visthrow.diagnose.likelihood import threads


def test_fewer_threads_work_beside_a_gpu(monkeypatch):
    asked, pool = [], threads._pool
    monkeypatch.setattr(threads, "cores", lambda: 16)
    monkeypatch.setattr(threads, "_aside", threading.Event())
    monkeypatch.setattr(
        threads, "_pool", lambda name, count: asked.append(count) or pool(name, count)
    )
    for _ in range(2):
        assert threads.each(lambda i: i * i, range(50)) == [i * i for i in range(50)]
        threads.aside()
    assert asked == [threads.MOST, threads.MOST_ASIDE]
