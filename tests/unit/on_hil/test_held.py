"""Commands that wait for a vehicle that acts sooner than the one that a policy was trained with."""

from pytest import approx, raises

from hil.links.backends import make_backend
from hil.links.backends.base import DryRun, Held
from tests.configs import load_run
from visthrow.common.errors import ConfigError


class SpyBackend(DryRun):
    """Keeps sent commands with their times."""

    def __init__(self):
        super().__init__()
        self.sent, self.release_due = [], None

    def send(self, command, now):
        self.sent.append((round(now, 6), command))
        return True

    def due(self):
        return self.release_due


def test_each_command_goes_out_so_much_later_and_none_is_lost():
    """Ticks every 20 ms, a wait of 25.5 ms: two commands wait at a time; a release that the
    back-end scheduled is served when it is due.
    """
    spy = SpyBackend()
    held = Held(spy, 0.0255)
    for tick in range(3):
        held.send((float(tick), 0.0, 0.0, 0.0), 0.02 * tick)
        held.service(0.02 * tick)
    assert [command[0] for _, command in spy.sent] == [0.0]
    assert held.due() == approx(0.0455)
    spy.release_due = 0.043
    assert held.due() == 0.043
    spy.release_due = None
    held.service(held.due())
    assert spy.sent[-1] == (0.0455, (1.0, 0.0, 0.0, 0.0))
    assert held.name == "dry-run"


def test_nothing_goes_out_after_the_end():
    spy = SpyBackend()
    held = Held(spy, 0.02)
    held.send((1.0, 0.0, 0.0, 0.0), 0.0)
    held.finish(0.01)
    held.service(1.0)
    assert spy.sent == []
    assert held.due() is None


def test_a_vehicle_acts_sooner_or_later_but_not_both():
    with raises(ConfigError, match="one of them 0"):
        load_run("fake", ["delay.hold=0.02", "delay.command=0.01"])
    assert isinstance(
        make_backend(load_run("dry_run", ["delay.hold=0.02"])),
        DryRun,
    )
