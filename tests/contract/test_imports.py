"""Imports run one way, and what flies on board runs where neither simulator nor trainer is installed."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("camera", "sim", "visthrow", "hil")

ONBOARD = ("config", "errors", "observations", "actions", "policy", "pilot", "flightlog", "hover")
"""Modules of visthrow that fly on board, and those that these are allowed to rest on."""
ONBOARD_SUPPORT = (
    "schema", "toml_text", "storage", "logexport", "provenance", "traced", "style",
    "strip", "rerun_view", "goal_motion", "damaged",
)  # fmt: skip

MAY_USE = {
    "camera": {"camera"},
    "sim": {"sim"},
    "visthrow": {"visthrow", "sim", "camera"},
    "hil": {"hil", "camera", *(f"visthrow.{name}" for name in ONBOARD + ONBOARD_SUPPORT)},
}
NUMPY_WARP_ONLY = {"torch", "cv2", "kornia", "rerun", "rsl_rl", "tensordict", "matplotlib"}
BLOCKED_ON_BOARD = ("sim", "warp", "rsl_rl", "tensordict", "mujoco")


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Return every absolute module name that a file imports anywhere, ``from a import b`` as ``a.b`` too."""
    names = set()
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*above, *([node.module] if node.module else [])))
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


def allowed(name: str, may_use: set[str]) -> bool:
    return any(name == known or name.startswith(known + ".") for known in may_use)


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_one_way(package):
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources(package)
        for name in imported(path)
        if name.split(".")[0] in PACKAGES and not allowed(name, MAY_USE[package])
    ]
    assert not wrong


def test_onboard_modules_import_only_onboard_modules():
    known = {"camera", *(f"visthrow.{name}" for name in ONBOARD + ONBOARD_SUPPORT), "visthrow.__version__"}
    wrong = [
        f"visthrow/{name}.py imports {target}"
        for name in ONBOARD + ONBOARD_SUPPORT
        for path in [ROOT / "visthrow" / f"{name}.py"]
        if path.exists()
        for target in imported(path)
        if target.split(".")[0] in PACKAGES and not allowed(target, known)
    ]
    assert not wrong


def test_sim_uses_numpy_and_warp_only():
    """Torch in the one bridge, MuJoCo in the reference plant only."""
    wrong = []
    for path in sources("sim"):
        banned = set(NUMPY_WARP_ONLY)
        if path.name == "torch_bridge.py":
            banned.discard("torch")
        if "reference" not in path.parts:
            banned.add("mujoco")
        else:
            banned.add("warp")
        wrong += [f"{path.relative_to(ROOT)} imports {name}" for name in imported(path) if name.split(".")[0] in banned]
    assert not wrong


def test_the_reference_plant_shares_only_the_parameters():
    """An oracle that called the simulator's code would agree with its mistakes."""
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources("sim/reference")
        for name in imported(path)
        if name.split(".")[0] == "sim" and not allowed(name, {"sim.reference", "sim.params"})
    ]
    assert not wrong


def test_onboard_modules_run_without_simulator_and_trainer():
    """Each onboard module and all of hil import in an interpreter where the heavy packages cannot be imported."""
    modules = [f"visthrow.{name}" for name in ONBOARD + ONBOARD_SUPPORT if (ROOT / "visthrow" / f"{name}.py").exists()]
    modules += [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in sources("hil")
    ]
    code = f"""
import importlib, sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BLOCKED_ON_BOARD!r}:
            raise ImportError("blocked on board: " + name)
sys.meta_path.insert(0, Blocker())
for name in {modules!r}:
    importlib.import_module(name)
try:
    import sim
except ImportError:
    print("done")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["done"], "the blocker itself must work"
    assert len(modules) > len(ONBOARD)


def test_importing_visthrow_and_the_command_line_is_cheap():
    code = "import sys, visthrow.cli; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert {"torch", "numpy", "warp", "cv2"}.isdisjoint(result.stdout.split())
