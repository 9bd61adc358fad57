"""A sweep whose process is killed, and started again."""

from tests.commands import run_command
from tests.train.test_train import iterations_of
from visthrow.paper.sweep.sweep_record import status
from visthrow.paper.sweep.work_units import load_list

LIST = """
changes = [
    "ppo.environments=32", "ppo.steps=8", "ppo.hidden=[16,16]", "ppo.iterations=4",
    "task.bounds.time_limit=0.4",
]
checkpoint_every = 2

[runs.tiny]
configs = ["laptop"]
seeds = [1]
throws = ["own"]

[throws.own]
plant = "hybrid"
targets = [2.0]
count = 2
"""


def test_a_killed_sweep_goes_on_and_does_nothing_twice(killed, tmp_path):
    path, out = tmp_path / "list.toml", tmp_path / "out"
    path.write_text(LIST)
    sweep = load_list(str(path))
    (source,) = sweep.sources
    units = ",".join((source.id, *(unit.id for unit in sweep.throws[source.id])))
    command = f"sweep work {path} --out {out} --units {units} --device cpu"
    folder = source.folder(out)
    killed(command)
    assert iterations_of(folder) == [1, 2, 3]
    assert not status(sweep, out)[1]
    assert run_command(command) == 0
    assert iterations_of(folder) == [1, 2, 3, 4]
    assert status(sweep, out)[1]
    results = [source.policy(out), *(out / "throws").iterdir()]
    made = [file.stat().st_mtime_ns for file in results]
    assert run_command(command) == 0
    assert [file.stat().st_mtime_ns for file in results] == made
