"""Impossible plants, cameras and trainings are refused when the configuration is read, and a copied
file finds its base.
"""

from pytest import approx, mark, raises

from tests.configs import load_experiment
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment, contract_of
from visthrow.training.trainer import adopt_layers


@mark.parametrize(
    ("kind", "name", "change", "message"),
    [
        ("vehicle", "paper", "body.mass=-1", "body: mass is -1.0; expected above 0"),
        ("rope", "paper", "payload_inertia=1.0", "payload_inertia"),
        ("camera", "fisheye", "fisheye.fov_deg=400", "expected above 0 and at most 360"),
        ("camera", "fisheye", "fisheye.k1=1e9", "1 deg off the axis"),
        ("task", "state", "bounds.altitude=[3,0.5]", "lower limit before the upper"),
        ("train", "state", "ppo.iterations=-3", "1 or more"),
        (
            "train",
            "state",
            "vehicle.body.mass=210",
            "quarter of the vehicle's weight, 515 N",
        ),  # grams
        ("train", "state", "rope.payload_mass=12", "it cannot hover"),
        (
            "train",
            "state",
            "task.action.max_thrust=2",
            "asked up to 2 N (task.action.max_thrust): it cannot hover",
        ),
        ("train", "state", "rope.length=34", "the payload hangs 34.053 m"),  # centimetres
        ("train", "state", "vehicle=x500", "did you mean 'vehicle/x500.toml'?"),
        (
            "train",
            "state",
            "task.start.spawn_height=133",
            "expected within task.bounds.altitude, 0.5 to 3 m",
        ),
        (
            "train",
            "state",
            "release.lag=110",
            "release: lag is 110.0; expected 0 to 5",
        ),  # milliseconds
        (
            "train",
            "state",
            "vehicle.motor.time_constant=33",
            "vehicle.motor.time_constant is 33 s",
        ),
        (
            "train",
            "state",
            "vehicle.rotors.x=[68,68,-68,-68]",
            "rotors: x is (68.0, 68.0, -68.0, -68.0); expected -10 to 10",
        ),  # millimetres
        (
            "train",
            "state",
            "vehicle.body.inertia=[2500,2500,4000]",
            "puts 0.21 kg 109 m from its middle",
        ),  # g cm^2
        (
            "train",
            "state",
            "vehicle.thrust.k_f=2.4e-9",
            "blade tips of 1.45e+03 m/s for 3.5 N",
        ),  # N/rpm^2
        (
            "train",
            "state",
            "vehicle.thrust.k_f=1",
            "expected more than the air through the rotor, 17.9 m/s",
        ),
    ],
)
def test_the_command_refuses(kind, name, change, message, refused):
    refused(f"config {kind} {name} --set {change}", message=message)


def test_the_thrust_of_an_action_is_the_vehicles_unless_it_is_set():
    sets = ["vehicle=vehicle/x500.toml"]
    heavy = load_experiment("state", sets)
    assert heavy.task.action.max_thrust == approx(4 * heavy.vehicle.controller.max_thrust)
    assert contract_of(heavy)["action"]["max_thrust"] == approx(45.2)
    assert config.loads(Experiment, config.dumps(heavy), (), name="run") == heavy
    weaker = load_experiment("state", [*sets, "task.action.max_thrust=30"])
    assert weaker.task.action.max_thrust == 30.0
    shipped = Policy.load(find_policy("state"))
    assert (
        adopt_layers(heavy, shipped).task.action == heavy.task.action
    )  # a throttle fits any vehicle


@mark.parametrize(
    ("vehicle", "expected"),
    [
        ("paper", (10.0, 10.0, 4.0)),
        ("five_inch", (10.0, 10.0, 3.043)),
        ("x500", (5.540, 5.540, 0.4614)),
    ],
)
def test_the_rates_of_an_action_are_those_that_the_motors_can_give(vehicle, expected):
    """A missing rate of 1 rad/s takes 1.01 N of each motor of an X500 in roll and 12.1 N in yaw, of
    a range of 11.2 N.
    """
    change = f"vehicle=vehicle/{vehicle}.toml"
    rates = load_experiment("state", [change]).task.action.max_rate
    assert rates == approx(expected, rel=1e-3)
    stated = load_experiment("state", [change, "task.action.max_rate=[9,8,3]"])
    assert stated.task.action.max_rate == (9.0, 8.0, 3.0)


@mark.parametrize("name", ["vision", "vision_ideal", "state_far"])
def test_a_copy_elsewhere_finds_its_base(name, tmp_path):
    shipped = config.find("train", name)
    copy = tmp_path / "mine.toml"
    copy.write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    assert config.load(Experiment, copy) == config.load(Experiment, shipped)


def test_a_base_that_is_nowhere_suggests_its_kind(tmp_path):
    (tmp_path / "mine.toml").write_text('base = "visoin.toml"', encoding="utf-8")
    with raises(ConfigError, match=r"did you mean 'train/vision\.toml'") as caught:
        config.load(Experiment, tmp_path / "mine.toml")
    assert "vehicle/" not in str(caught.value)
