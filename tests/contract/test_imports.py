"""Imports run one way, and what flies on board runs where neither simulator nor trainer is
installed.
"""

import ast
import os
import re
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from pytest import mark

from sim.solvers import SOLVERS
from tests.commands import run_python
from tests.places import ROOT

OURS = {**os.environ, "PYTHONPATH": str(ROOT)}
PACKAGES = ("camera", "sim", "visthrow", "hil")
WORLDS = "bench/worlds"

ONBOARD = (
    "visthrow.config",
    "visthrow.common",
    "visthrow.onboard",
    "visthrow.logs",
    "visthrow.view",
)
"""Rooms of visthrow that fly on board; they rest on each other and on camera alone."""

OPTIONAL_ROOMS = ("visthrow.paper", "visthrow.detector_training", "hil.rehearsal")
EXTRAS = (  # packages that an installation without extras lacks
    *("mujoco", "piqp", "pyulog", "rosbags", "h5py", "mcap", "skimage", "submitit", "serial"),
    *("cflib", "cyclonedds", "natnet", "motioncapture", "mujoco_warp", "aeroid"),
    *("onnx", "onnxscript"),
)
ON_THE_GROUND = (  # extras train, view, pictures
    *("warp", "rsl_rl", "tensordict", "kornia", "rerun", "pyarrow", "cv2", "matplotlib", "scipy"),
)
BLOCKED_ON_BOARD = ("sim", "warp", "rsl_rl", "tensordict", "mujoco")


def sources(place: str) -> list[Path]:
    """Return the modules whose path from the root begins as a pattern says."""
    folders = [ROOT / name for name in (*PACKAGES, WORLDS)]
    paths = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    return [path for path in paths if re.match(place, path.relative_to(ROOT).as_posix())]


def imports_of(path: Path, root: Path) -> set[str]:
    """Return every absolute module name that a file imports anywhere, ``from a import b`` as
    ``a.b`` too.
    """
    names = set()
    package = path.relative_to(root).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*above, *([node.module] if node.module else [])))
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


@cache
def find_imports(path: Path) -> set[str]:
    return imports_of(path, ROOT)


RULES = [
    ("camera/", PACKAGES, ("camera",)),
    ("sim/", PACKAGES, ("sim", "camera.warp_start", "camera.field_bounds")),
    ("visthrow/", PACKAGES, ("visthrow", "sim", "camera")),
    ("hil/", PACKAGES, ("hil", "camera", *ONBOARD)),
    ("sim/", ("cv2", "kornia", "rerun", "rsl_rl", "tensordict", "matplotlib"), ()),
    ("sim/(?!torch_bridge.py)", ("torch",), ()),
    ("sim/(?!reference/|solvers/)", ("mujoco",), ()),
    ("sim/reference/", ("warp",), ()),
    # An oracle, or a world, that called the simulator's code would agree with its mistakes.
    ("sim/reference/", ("sim",), ("sim.reference", "sim.params")),
    (WORLDS, (*PACKAGES, "bench"), ("bench.worlds",)),
    *[
        (room.replace(".", "/"), PACKAGES, ("camera", *ONBOARD, "visthrow.__version__"))
        for room in ONBOARD
    ],
    *[(f"(?!{room.replace('.', '/')}/)", (room,), ()) for room in OPTIONAL_ROOMS],
]
"""Pattern of modules, packages that they must not import, and exceptions."""


def begins(name: str, known: Iterable[str]) -> bool:
    return any(name == one or name.startswith(one + ".") for one in known)


@mark.parametrize(("place", "packages", "allowed"), RULES)
def test_a_place_imports_what_it_may(place, packages, allowed):
    assert sources(place)
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources(place)
        for name in find_imports(path)
        if begins(name, packages) and not begins(name, allowed)
    ]
    assert not wrong


def modules(*rooms: str) -> list[str]:
    """Return the modules in rooms given by their dotted names."""
    paths = [path for room in rooms for path in sources(room.replace(".", "/") + "/")]
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in paths
    ]


def test_an_optional_room_names_its_extra(monkeypatch, refused):

    monkeypatch.setitem(sys.modules, "piqp", None)
    monkeypatch.delitem(sys.modules, "visthrow.paper.baseline.rival", raising=False)
    refused("compare baseline --throws 1", message="pip install 'visthrow[paper]'")


def test_the_core_trains_flies_compares_and_diagnoses_without_the_extras(tmp_path):
    """Optional rooms and the packages of extras are hidden, as where they are not installed."""
    commands = [
        "train laptop --set ppo.iterations=1 --set ppo.environments=8 --out trained --device cpu",
        "fly --policy state --out flown --device cpu",
        "compare trained/policy.npz --throws 1 --targets 1.5 --out compared --device cpu",
        "diagnose check flown/flight.npz --no-pictures",
        "diagnose explain flown/flight.npz --only com_x --no-report --set rope.segments=1",
    ]
    code = f"""
import sys
sys.modules.update(dict.fromkeys({(*EXTRAS, *OPTIONAL_ROOMS, "bench", "tests")!r}))
from visthrow.cli import main
from visthrow.training import trainer
trainer.EVALUATED = 4
for words in {commands!r}:
    assert main(words.split()) == 0, words
"""
    result = run_python("-c", code, cwd=tmp_path, env=OURS)
    assert result.returncode == 0, result.stderr


def test_what_flies_needs_neither_train_nor_view(tmp_path):
    """A run on recorded poses and its replay; the rest names its extra."""
    poses = ROOT / "tests" / "data" / "payload_cf_single" / "log201.csv.gz"
    flying = [
        f"hil run --config crazyflie_log --set source.file={poses} --out run",
        "hil replay run",
    ]
    refused = {"fly": "train", "train laptop": "train", "hil view run": "pictures"}
    refused["policy export state --out p.onnx"] = "onnx"
    code = f"""
import contextlib, io, sys
sys.modules.update(dict.fromkeys({(*ON_THE_GROUND, *EXTRAS)!r}))
from visthrow.cli import main
for words in {flying!r}:
    assert main(words.split()) == 0, words
for words, extra in {refused!r}.items():
    with contextlib.redirect_stderr(io.StringIO()) as text:
        assert main(words.split()) == 2, words
    assert f"pip install 'visthrow[{{extra}}]'" in text.getvalue(), (words, text.getvalue())
"""
    result = run_python("-c", code, cwd=tmp_path, env=OURS)
    assert result.returncode == 0, result.stderr


def test_onboard_modules_run_without_simulator_and_trainer():
    """Each onboard module and all of hil import in an interpreter where the heavy packages cannot
    be imported.
    """
    names = modules("hil", *ONBOARD)
    code = f"""
import importlib, sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BLOCKED_ON_BOARD!r}:
            raise ImportError("blocked on board: " + name)
sys.meta_path.insert(0, Blocker())
for name in {names!r}:
    importlib.import_module(name)
try:
    import sim
except ImportError:
    print("done")
"""
    result = run_python("-c", code, cwd=ROOT)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["done"], "the blocker itself must work"
    assert len(names) > len(ONBOARD)


def test_only_the_configuration_names_a_solver():
    """``visthrow`` and ``hil`` know the simulator, not the engine behind it."""
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources("visthrow/|hil/")
        for name in SOLVERS
        if name in path.read_text(encoding="utf-8")
    ]
    assert not wrong
