"""A constant that stands for a firmware's behaviour comes from the table of facts.

In modules that speak for a firmware no number stands outside of module constants and defaults, but
those of arithmetic; parameter names stand in rows of the table. :data:`CHOICES` names each module
constant that is our choice.
"""

import ast
import re

from pytest import mark

from hil.links.backends.audit import RULES
from hil.links.facts import FOLDER, facts
from tests.places import ROOT

FIRMWARES = [path.stem for path in FOLDER.glob("*.toml")]
FACTS = {name: fact for firmware in FIRMWARES for name, fact in facts(firmware).items()}

PLAIN = {0, 1, 2, 3, 4, 0.5, 10, 100, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 0.01}
PLAIN |= {255, 256, 65535, 65536, 0xFFFFFFFF}
"""Numbers of arithmetic: ends of ranges, units, axes, numbers of a command, bytes."""

CHOICES = {
    "hil/links/backends/__init__.py": "THRUST_SHORT",
    "hil/links/backends/audit.py": "ASK_AGAIN GIVE_UP GIVE_UP_OPTIONAL",
    "hil/links/backends/mavlink_autopilot.py": "ASK_AGAIN CONFIRMATION_TIME STREAM SERVO_NEAR",
    "hil/links/backends/base.py": "REPEAT",
    "hil/links/backends/betaflight.py": "EXPIRES FEWEST_AUX ARRIVED KEEP_ALIVE OPEN_TIME"
    " ARM_LOW POLLS READ_BACK RATES_PERIOD RATES_TIME",
    "hil/links/backends/crazyflie.py": "ASK ARM_PERIOD HOLDS DESCENT SHORTEST",
    "tests/fakes/fake_crazyflie.py": "GYRO_NOISE",
    "hil/links/backends/crazyflie_gyro.py": "BLOCK PERIOD_MS AT_ONCE ASK_AGAIN STAMP",
    "hil/links/backends/px4.py": "MARGIN GAP",
    "hil/links/backends/thrust_curve.py": "LEAST_SHARES VOLTAGE_RANGE",
    "hil/links/device.py": "MOST_CHUNKS MOST_SHUT_OUT",
    "hil/links/mavlink_link.py": "OUR_SYSTEM OUR_COMPONENT COMMAND_VALUES IDS MOST_PENDING"
    " ASK_EVERY EARLY LATE",
    "hil/links/pymav.py": "KEY_BYTES TICKS EPOCH LAG_LIMIT LEAST_WORD",
    "hil/links/roster.py": "SILENT MOST_SAID",
    "hil/links/team_link.py": "WINDOW",
    "hil/links/writer.py": "MOST_WAITING WRITE_EVERY",
    "hil/rehearsal/bridges/ardupilot_bridge.py": "LOW HIGH ARRIVED",
    "hil/rehearsal/bridges/betaflight_bridge.py": "ASK SAMPLE",
    "hil/rehearsal/bridges/betaflight_firmware.py": "LAST_WORDS LOOK_AGAIN START ANSWER END FREED",
    "hil/rehearsal/bridges/packets.py": "TIME MOTORS LARGEST_ANSWER SEA_LEVEL STEP CALIBRATION",
    "hil/rehearsal/bridges/px4_bridge.py": "STREAMS ARRIVED HALVING MOST_DAMPING SETTLING",
    "hil/rehearsal/fake.py": "MOST_EVENTS ROOM DESCENT LOWEST TOUCH GOES_ON COVARIANCES THRUST",
    "hil/rehearsal/fake_command.py": "BRIDGE_ID BALL_LAG",
    "hil/rehearsal/fake_mavlink.py": "OUTPUTS FLIES SERVO",
}
"""Module -> constants that are a choice of ours or of a protocol, not a firmware's behaviour."""

PATHS = sorted(
    str(path.relative_to(ROOT))
    for folder in ("hil/links", "hil/rehearsal")
    for path in (ROOT / folder).rglob("*.py")
) + ["tests/fakes/fake_crazyflie.py"]

PARAMETER = re.compile(
    r"(flightmode|stabilizer|motorPowerSet)\.\w+|MSP_\w+|[A-Z][A-Z0-9]+_[A-Z0-9_]+"
)
"""Names that a firmware gave."""
MESSAGES = re.compile(
    r"(ATT_POS|VISION_POSITION|SERVO_OUTPUT|COMMAND|PARAM|VFR|SYS|SET_ATTITUDE|ATTITUDE|HIL_STATE"
    r"|NAMED_VALUE|MAV|LD|VISTHROW)_\w+"
)
"""Messages of MAVLink, by the library; variables of processes."""


def names(target: ast.expr) -> set[str]:
    """Return the names that an assignment binds."""
    return {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}


def has_row(parameter: str) -> bool:
    """Return whether a row of the table names a parameter."""
    word = re.compile(rf"\b{re.escape(parameter)}\b")
    return any(
        word.search(text)
        for name, fact in FACTS.items()
        for text in (name, str(fact.value), fact.text, fact.means)
    )


def offences(text: str, choices: set[str]) -> list[str]:
    """Return numbers and parameter names of a module that have no source, with their line."""
    tree = ast.parse(text)
    free: set[int] = set()  # literals of ours, of annotations' bounds, and defaults of options
    for node in ast.walk(tree):
        ours = isinstance(node, ast.Assign) and set().union(*map(names, node.targets)) & choices
        option = isinstance(node, ast.keyword) and node.arg == "default"
        if ours or option or isinstance(node, ast.AnnAssign):
            free |= {id(part) for part in ast.walk(node)}
    missing = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or isinstance(node.value, bool):
            continue
        value = node.value
        number = isinstance(value, int | float) and abs(value) not in PLAIN and id(node) not in free
        named = isinstance(value, str) and PARAMETER.fullmatch(value)
        if number or (named and not MESSAGES.fullmatch(value) and not has_row(value)):
            missing.append(f"{node.lineno}: {value!r}")
    return missing


@mark.parametrize("path", PATHS)
def test_no_constant_of_a_firmware_without_a_source(path):
    choices = set(CHOICES.get(path, "").split())
    assert offences((ROOT / path).read_text(encoding="utf-8"), choices) == []


@mark.parametrize("firmware", ["ardupilot", "px4"])
def test_each_audited_parameter_has_a_row(firmware):
    names = [row["name"] for row in RULES[firmware]]
    parameters = [name for name in names if PARAMETER.fullmatch(name)]
    assert len(parameters) >= 3
    assert [name for name in parameters if not has_row(name)] == []


def test_a_constant_without_a_source_is_found():
    assert offences("LEVELS_AFTER = 0.36\n", set()) == ["1: 0.36"]
    assert offences("ASK = 0.36\n", {"ASK"}) == []
    assert offences("def f():\n    return set('flightmode.other', 42)\n", set()) == [
        "2: 'flightmode.other'",
        "2: 42",
    ]
    assert offences("rule = Rule('GRIP_COLOUR', '')\n", set()) == ["1: 'GRIP_COLOUR'"]
    assert offences("rule = Rule('GRIP_RELEASE', '')\n", set()) == []


SAYINGS = [
    ("betaflight", r"pilot's sticks after ([\d.]+) s", "override_window"),
    ("crazyflie", r"levels after ([\d.]+) s", "levels_after"),
    ("crazyflie", r"lock after ([\d.]+) s", "stops_after"),
    ("crazyflie", r"controller divided by (\d+)", "manual_thrust"),
    ("faults", r"Since: the pilot's sticks after ([\d.]+) s", "override_window"),
]
"""Page, words with a number, and the row that has the number."""


@mark.parametrize(("page", "words", "name"), SAYINGS)
def test_a_page_gives_the_number_of_the_table(page, words, name):
    text = (ROOT / f"docs/pilots/{page}.md").read_text(encoding="utf-8")
    assert float(re.search(words, text)[1]) == FACTS[name].value
