"""Run tasks as jobs of a Slurm cluster, through submitit; its local executor runs the same jobs as
processes, for a test.
"""

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from visthrow.common.errors import ConfigError
from visthrow.paper.sweep import Changes
from visthrow.paper.sweep.pool import Task
from visthrow.paper.sweep.work import EXIT_STOPPED, work
from visthrow.paper.sweep.work_units import load_list

SLACK = 5  # additional time of a job for the start of the process and the last checkpoint [min]

# number of times that a task's job may be lost (preempted, out of time, node down) before the task
# counts as failed
LOST_AT_MOST = 3


class ClusterJob:
    """A submitted task."""

    def __init__(self, job: Any, task: str, lost: Counter[str]):
        self._job = job
        self._task = task
        self._lost = lost

    def poll(self) -> int | None:
        from submitit.core.utils import FailedJobError, UncompletedJobError

        if not self._job.done():
            return None
        try:
            return int(self._job.result())
        except FailedJobError:  # the work raised an error, which is in its output
            return 1
        except UncompletedJobError:
            self._lost[self._task] += 1
            return EXIT_STOPPED if self._lost[self._task] <= LOST_AT_MOST else 1

    def stop(self) -> None:
        """Cancel the job; on Slurm's signal a training writes its checkpoint."""
        self._job.cancel()

    kill = stop


@dataclass
class Cluster:
    """A cluster to which tasks are submitted."""

    list_name: str
    out: Path
    executor: str  # "slurm", or "local" for processes of this machine
    gpus: int
    jobs: int
    minutes: float  # duration of a job's work; unfinished work is submitted again
    changes: Changes = ()
    # options of submitit's executor, for instance ``slurm_partition``
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        import submitit

        self.devices = [f"job {i}" for i in range(self.gpus)]
        self._lost: Counter[str] = Counter()
        try:
            self._executor = submitit.AutoExecutor(self.out / "logs", cluster=self.executor)
        except RuntimeError as error:
            raise ConfigError(
                f"no jobs can be submitted from here: {error}; expected the commands of"
                f" {self.executor}"
            ) from error
        try:
            self._executor.update_parameters(
                timeout_min=int(self.minutes) + 1 + SLACK, **self.options
            )
        except (NameError, ValueError, TypeError) as error:
            raise ConfigError(f"options of the cluster {self.options}: {error}") from error

    def start(self, task: Task, device: str, minutes: float) -> ClusterJob:
        self._executor.update_parameters(
            name=task.name, gpus_per_node=1 if task.gpu and self.executor == "slurm" else 0
        )
        piece = min(minutes, self.minutes)
        where = (self.list_name, str(self.out.resolve()), self.changes, os.getcwd())
        job = self._executor.submit(do, *where, task.ids, "auto" if task.gpu else "cpu", piece)
        return ClusterJob(job, task.name, self._lost)


def do(
    list_name: str,
    out: str,
    changes: Changes,
    folder: str,
    ids: tuple[str, ...],
    device: str,
    minutes: float,
) -> int:
    """Do a task's units in a job; return the exit status of ``visthrow sweep work``."""
    os.chdir(folder)
    return work(load_list(list_name, changes), Path(out), ids, device, minutes)
