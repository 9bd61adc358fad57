"""Capturing in a CUDA graph: what may not happen meanwhile."""

import contextlib
import gc

import pytest
import torch

from sim.torch_bridge import captured


class Old:
    """Garbage in a circle, as what a replaced simulator leaves; frees memory when it is
    collected.
    """

    def __init__(self, freed: list) -> None:
        self.me, self.freed = self, freed

    def __del__(self) -> None:
        self.freed.append(True)


@pytest.fixture(params=[True, False], ids=["collects", "does not"])
def collects(request):
    """Whether the process collects garbage by itself."""
    was = gc.isenabled()
    (gc.enable if request.param else gc.disable)()
    yield request.param
    (gc.enable if was else gc.disable)()


@pytest.mark.parametrize("fails", [False, True])
def test_garbage_is_collected_before_a_capture_and_not_during_it(monkeypatch, collects, fails):
    """On an H200 arrays of an earlier test, freed during a capture, ended it:

    Warp CUDA error 900.
    """
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", object)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, **options: contextlib.nullcontext())
    before, during = [], []
    Old(before)

    def work():
        assert before, "what was there before is gone"
        Old(during)
        assert not gc.isenabled()
        [[] for _ in range(5000)]  # more than lets the collector run by itself
        assert not during
        if fails:
            raise ValueError("work")

    with pytest.raises(ValueError, match="work") if fails else contextlib.nullcontext():
        captured(work)
    assert gc.isenabled() == collects
