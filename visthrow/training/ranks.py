"""The processes of one training, a GPU or a share of the cores each: what they agree on and what
they share.
"""

import gc
import os
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from rsl_rl.utils import reduce_gradients_in_buckets
from torch import distributed, nn

BUCKET_MB = 64.0  # gradients that are averaged at once [MB]


@dataclass(frozen=True)
class Ranks:
    """This process among those of its training; the default is a training in one process."""

    device: str = "cpu"  # or "cuda:0"
    rank: int = 0  # of this process
    local: int = 0  # of this process on its machine
    world: int = 1  # number of processes

    @classmethod
    def join(cls, on_gpu: bool) -> "Ranks":
        """Join the processes that torchrun started, over NCCL on GPUs and Gloo on CPUs."""
        rank, local, world = (
            int(os.environ[name]) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE")
        )
        if on_gpu:
            torch.cuda.set_device(local)
        distributed.init_process_group("nccl" if on_gpu else "gloo", rank=rank, world_size=world)
        return cls(f"cuda:{local}" if on_gpu else "cpu", rank, local, world)

    @property
    def lead(self) -> bool:
        """Whether this process evaluates, reports and writes."""
        return self.rank == 0

    @property
    def rsl_rl(self) -> dict | None:
        """rsl_rl's ``multi_gpu`` dictionary."""
        if self.world > 1:
            return {"global_rank": self.rank, "local_rank": self.local, "world_size": self.world}
        return None

    def share(self, *modules: nn.Module) -> None:
        """Give every process the first one's weights and buffers."""
        if self.world > 1:
            for module in modules:
                for tensor in module.state_dict().values():
                    distributed.broadcast(tensor, src=0)

    def average(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their mean over the processes."""
        if self.world > 1:
            reduce_gradients_in_buckets(parameters, self.world, BUCKET_MB)

    def agree(self, number: int) -> int:
        """Highest of the processes' numbers."""
        if self.world == 1:
            return number
        tensor = torch.tensor(number, device=self.device)
        distributed.all_reduce(tensor, op=distributed.ReduceOp.MAX)
        return int(tensor)

    def gather(self, state: dict) -> list[dict]:
        """Every process' state, in the order of ranks; of use to the lead alone."""
        states = [state] * self.world
        if self.world > 1:
            distributed.gather_object(state, states if self.lead else None)
        return states

    def leave(self) -> None:
        """Part from the others.

        No CUDA graph with collectives may be left: NCCL would wait for it for ever.
        """
        if self.world > 1:
            gc.collect()
            distributed.destroy_process_group()
