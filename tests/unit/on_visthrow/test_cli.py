"""The command line: quick help, one clear message for a mistake, exit statuses."""

import os
import re
import runpy
import subprocess
import sys
import time
import types
from functools import partial
from pathlib import Path

from pytest import fixture, mark, raises

from tests.commands import run_command, run_python, start
from tests.places import ROOT
from visthrow import cli
from visthrow.common import arguments, compute_device
from visthrow.common.errors import ConfigError, DeviceError, VisthrowError, suggest
from visthrow.config import kinds

HELP_BUDGET = 0.5
"""[s], bar of the project for ``visthrow --help``, interpreter start included; the best of a few
runs counts.
"""

OPTIONS = ("--set", "--device", "--json")
"""Of the command that tests install."""


def run(*arguments: str, **options) -> subprocess.CompletedProcess:
    return run_python("-m", "visthrow.cli", *arguments, **options)


@fixture
def command(monkeypatch):
    """Install a command 'try' whose ``run`` raises or returns a given value."""

    def install(outcome):
        def run(args):
            if isinstance(outcome, BaseException):
                raise outcome
            return outcome

        module = types.ModuleType("fake_command")
        module.add_arguments = partial(
            arguments.add_table, {"arguments": {name: {"shared": True} for name in OPTIONS}}
        )
        module.run = run
        monkeypatch.setitem(sys.modules, "fake_command", module)
        monkeypatch.setitem(cli.COMMANDS, "try", ("try it", "fake_command"))

    return install


def test_help_is_quick_and_names_every_command():
    best = float("inf")
    for _ in range(3):
        start = time.perf_counter()
        result = run("--help")
        best = min(best, time.perf_counter() - start)
    assert result.returncode == 0
    assert all(name in result.stdout for name in cli.COMMANDS)
    assert "examples:" in result.stdout
    assert best < HELP_BUDGET


def test_a_file_that_hides_a_package_of_ours_is_named(tmp_path):
    """``python -m visthrow.cli`` looks into the working folder first; a user's ``camera.py`` lies
    there.
    """
    (tmp_path / "camera.py").write_text("")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = run("config", "camera", "fisheye", cwd=tmp_path, env=environment)
    assert result.returncode == 2
    assert f"{tmp_path / 'camera.py'} hides visthrow's own package" in result.stderr
    assert "Traceback" not in result.stderr


@mark.parametrize(
    "does", [["config", "train", "vision"], ["compare", "visoin"], ["fly", "--policy", "visoin"]]
)
def test_configurations_and_misspelt_names_import_neither_torch_nor_warp(does):
    code = f"import sys; from visthrow.cli import main; main({does}); print(*sys.modules)"
    result = run_python("-c", code, check=True)
    assert {"torch", "warp"}.isdisjoint(result.stdout.split())


def test_help_of_train_names_the_policies_that_the_readme_shows():
    shown = re.findall(r"^\| `(\w+)` ", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert shown == ["state", "vision", "vision_located"]
    assert set(shown) <= set(re.findall(r"\w+", run("train", "--help").stdout))


def test_no_command_and_unknown_command_list_the_commands():
    for words in ((), ("thrwo",)):
        result = run(*words)
        assert result.returncode == 2
        assert "Traceback" not in result.stderr
    assert "compare" in result.stderr


@mark.parametrize("error", [ConfigError("a: b"), ValueError("a: b"), OSError(28, "a: b")])
def test_a_mistake_is_one_message_and_status_2(command, capsys, monkeypatch, error):
    command(error)
    monkeypatch.delenv(cli.TRACEBACK_VARIABLE, raising=False)
    assert cli.main(["try"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("visthrow: error: ")
    assert "a: b" in err
    assert err.count("\n") == 1
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, "1")
    with raises(type(error)):
        cli.main(["try"])


def test_defects_are_not_hidden(command):
    command(KeyError("a defect"))
    with raises(KeyError):
        cli.main(["try"])


def test_ctrl_c_is_status_130(command, capsys):
    command(KeyboardInterrupt())
    assert cli.main(["try"]) == 130
    assert "Traceback" not in capsys.readouterr().err


def test_a_reader_that_goes_away_is_no_failure():
    """As in ``visthrow config train | head -1``."""
    child = start("config vehicle paper", stdout=subprocess.PIPE)
    child.stdout.close()
    assert child.wait() == 0


def test_a_place_that_cannot_be_written_is_refused_before_the_work(command, tmp_path, refused):
    command(KeyboardInterrupt())
    refused(f"try --json {tmp_path}", message="it is a folder")


def test_a_missing_optional_package_names_the_extra(command, capsys):
    command(ModuleNotFoundError("No module named 'mujoco'", name="mujoco"))
    assert cli.main(["try"]) == 2
    assert "visthrow[reference]" in capsys.readouterr().err
    command(ModuleNotFoundError("No module named 'mujoco.batch'", name="mujoco.batch"))
    assert cli.main(["try"]) == 2
    assert "MuJoCo 3" in capsys.readouterr().err
    command(ModuleNotFoundError("No module named 'visthrow.gone'", name="visthrow.gone"))
    with raises(ModuleNotFoundError):
        cli.main(["try"])


def test_the_command_s_status_is_returned(command):
    command(3)
    assert run_command("try --device cpu --set a=1 --set b.c=2 --json x") == 3
    command(None)
    assert cli.main(["try"]) == 0


def test_config_prints_what_loads_back(tmp_path, printed):
    from sim.params import VehicleParams
    from visthrow import config

    command = f"config vehicle paper --set body.mass=0.25 --json {tmp_path}/a.json"
    assert config.loads(VehicleParams, printed(command)).body.mass == 0.25
    assert '"mass": 0.25' in (tmp_path / "a.json").read_text()
    assert "paper" in printed("config vehicle").split()


@mark.parametrize(
    ("arguments", "message"),
    [
        ("config vehicel", "did you mean 'vehicle'"),
        ("config vehicle papr", "did you mean 'paper'"),
        ("config vehicle paper --set body.mas=1", "did you mean 'mass'"),
        ("config vehicle --set body.mass=1", "--set needs the NAME"),
        (
            "config vehicle paper --set body.mass=-1",
            "above 0 and at most 100000 (with body.mass=-1)",
        ),
        ("config vehicle deep.toml", "deep.toml: not valid TOML: brackets are nested too"),
        ("sweep status trial --out deep.toml", "deep.toml is a file; expected a"),
    ],
)
def test_config_mistakes(arguments, message, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("deep.toml").write_text(f"a = {'[' * 3000}{']' * 3000}")
    refused(arguments, message=message)


@mark.parametrize(
    ("words", "message"),
    [
        (
            "camera show fisheye --target nan 0",
            "--target: 'nan'; expected a finite number",
        ),
        (
            "camera show fisheye --height -1",
            "--height: '-1'; expected a number above 0",
        ),
        ("train state --minutes inf", "--minutes: 'inf'; expected a number above 0"),
        ("train state --until -0.1", "--until: '-0.1'; expected a number above 0"),
        ("diagnose map a.csv --mass -2", "--mass: '-2'; expected a number above 0"),
        ("fly --seed -1", "--seed: '-1'; expected a whole number of 0 or more"),
        ("compare --throws 0", "--throws: '0'; expected a whole number of 1 or more"),
        ("compare --targets 3.01", "--targets: '3.01'; expected a distance from 0 to 3 m"),
        ("compare --targets -0.01", "--targets: '-0.01'; expected a distance from 0 to 3 m"),
        ("hil check --speed 0", "--speed: '0'; expected a number above 0"),
        ("hil run --seconds 0", "--seconds: '0'; expected a number above 0"),
        ("hil check --seconds nan", "--seconds: 'nan'; expected a number above 0"),
        ("hil fake --after -3", "--after: '-3'; expected a number above 0"),
        (
            "hil fake --msp-port 70000",
            "--msp-port: '70000'; expected a port, 1 to 65535",
        ),
    ],
)
def test_numbers_that_mean_nothing_are_refused_before_the_work(words, message, capsys):
    with raises(SystemExit, match="2"):
        run_command(words)
    assert message in capsys.readouterr().err


def test_a_file_of_windows_notepad_is_read(tmp_path):
    from sim.params import VehicleParams
    from visthrow import config

    path = tmp_path / "bom.toml"
    path.write_text('base = "vehicle/paper.toml"\n', encoding="utf-8-sig")
    assert config.load(VehicleParams, path).body.mass == 0.21


@mark.parametrize("resolve", [compute_device.resolve, compute_device.resolve_for_warp])
def test_devices_that_do_not_exist_are_refused(resolve):
    assert resolve("cpu") == "cpu"
    assert resolve("auto") in ("cpu", "cuda:0")
    with raises(DeviceError, match=r"no device 'cuda:99'; expected auto or one of cpu"):
        resolve("cuda:99")


def test_suggestions():
    assert suggest("mas", ["mass", "inertia"]) == "did you mean 'mass'? Known: inertia, mass"
    assert suggest("xyz", ["mass"]) == "known: mass"
    many = suggest("stat", ["state", *(f"name{i}" for i in range(40))])
    assert many.startswith("did you mean 'state'? Near it: state; ")
    assert many.endswith(" 40 more exist")
    none = suggest("battery_used", [f"name{i}" for i in range(41)])
    assert none == "none of the 41 known names is near it"
    assert suggest("xyz", []) == "nothing is known here"
    assert issubclass(ConfigError, VisthrowError)
    with raises(ConfigError, match="no kind of config 'nothing'"):
        kinds.schema_of("nothing")


class MixedMujoco:
    """The failure of importing mujoco.batch where MuJoCo 3 was installed over parts of mujoco-core
    4.
    """

    def find_spec(self, name, path=None, target=None):
        if name == "mujoco.batch":
            raise AttributeError("mjtState has no attribute 'mjSTATE_PLASTIC'")


def test_a_mixed_mujoco_is_named_by_plants_and_solvers(monkeypatch):
    for name in ("mujoco.batch", "sim.reference.batch"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr(sys, "meta_path", [MixedMujoco(), *sys.meta_path])
    with raises(ModuleNotFoundError, match="another MuJoCo") as caught:
        runpy.run_module("sim.reference.rope")
    assert caught.value.name == "mujoco.batch"
    solver = runpy.run_module("sim.solvers.mujoco")
    with raises(ModuleNotFoundError, match="another MuJoCo"):
        solver["_make_on_cpu"](None, {}, 1, "cpu")
