"""Communicate between the processes of one training, each on a GPU or on a share of the cores."""

import gc
import os
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from rsl_rl.utils import reduce_gradients_in_buckets
from torch import distributed, nn

BUCKET_MB = 64.0  # size of the gradients that one call averages [MB]


@dataclass(frozen=True)
class Ranks:
    """One process of a training; by default the only one."""

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
        """Return whether this process evaluates, reports and writes."""
        return self.rank == 0

    @property
    def rsl_rl(self) -> dict | None:
        """Return rsl_rl's ``multi_gpu`` dictionary; None for a single process."""
        if self.world > 1:
            return {"global_rank": self.rank, "local_rank": self.local, "world_size": self.world}
        return None

    def share(self, *modules: nn.Module) -> None:
        """Copy the first process's weights and buffers to every process."""
        if self.world > 1:
            for module in modules:
                for tensor in module.state_dict().values():
                    distributed.broadcast(tensor, src=0)

    def average(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their mean over the processes."""
        if self.world > 1:
            reduce_gradients_in_buckets(parameters, self.world, BUCKET_MB)

    def agree(self, number: int) -> int:
        """Return the highest of the processes' numbers."""
        if self.world == 1:
            return number
        tensor = torch.tensor(number, device=self.device)
        distributed.all_reduce(tensor, op=distributed.ReduceOp.MAX)
        return int(tensor)

    def gather(self, state: dict) -> list[dict]:
        """Return the states of all processes in the order of ranks; only valid in the lead."""
        states = [state] * self.world
        if self.world > 1:
            distributed.gather_object(state, states if self.lead else None)
        return states

    def leave(self) -> None:
        """Leave the process group.

        No CUDA graph with collectives may exist any more: NCCL would wait for it forever.
        """
        if self.world > 1:
            gc.collect()
            distributed.destroy_process_group()
