"""The order of every number of an observation, by hand: training and flight share the code, so
neither would detect an exchange.
"""

import torch

from tests.configs import load_experiment
from visthrow.onboard import observations as ob

POS, VEL, RATE = (
    torch.tensor([[1.0, 2, 3]]),
    torch.tensor([[4.0, 5, 6]]),
    torch.tensor([[7.0, 8, 9]]),
)
TURN = torch.tensor([[[10.0, 11, 12], [13, 14, 15], [16, 17, 18]]])
VEHICLE = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 16, 11, 14, 17]  # rotation: two columns


def test_a_vehicle_and_its_goal():
    assert ob.vehicle_part(POS, VEL, RATE, TURN).tolist() == [VEHICLE]
    goal, payload = torch.tensor([[20.0, 30.0, 0.0]]), torch.tensor([[1.5, 2.75, 2.0]])
    assert ob.state_part(POS, goal, payload).tolist() == [[18.5, 27.25, 0.5, 0.75, -1.0]]


def test_what_the_vehicle_answered():
    frame = torch.cat([ob.vehicle_part(POS, VEL, RATE, TURN), torch.zeros(1, 5)], dim=-1)
    previous = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5]])
    expected = torch.tensor([[4, 5, 6, 7, 8, 9, 0.1, 0.2, 0.3, 0.4]])
    assert torch.equal(ob.answer(frame, previous), expected)


def test_the_papers_state_is_assembled_in_its_order():
    layout = ob.layout_of(load_experiment("state").task.observation)
    frame = torch.tensor([[*VEHICLE, 100, 101, 102, 103, 104]], dtype=torch.float32)
    previous = torch.tensor([[60.0, 61, 62, 63, 64]])
    history = torch.arange(200.0, 200 + 3 * (1 + layout.history)).reshape(1, -1, 3)
    old = history.flatten().tolist()
    for fresh in (False, True):
        observation, after = ob.observe(
            layout, frame, None, previous, torch.tensor([1.0]), history, torch.tensor([fresh])
        )
        now = [102.0, 103.0, 104.0]
        past = now * layout.history if fresh else old[: 3 * layout.history]
        assert observation.tolist() == [[*VEHICLE, 60, 61, 62, 63, 64, 100, 101, *now, *past, 1.0]]
        assert after.flatten().tolist() == [*now, *past]
    assert layout.dimension == 35
