"""Find policy files. Quick to import, so that a misspelt name is reported at once. Onboard-safe."""

from pathlib import Path

from visthrow.common.errors import PolicyError, suggest

# folder of the policies in the package
SHIPPED = Path(__file__).resolve().parent / "policies"


def find_policy(name: str | Path) -> Path:
    """Find a policy by the name of a shipped one (``vision``) or by the path of a file.

    Raises PolicyError: neither exists; the message lists the shipped ones.
    """
    for candidate in (Path(name), SHIPPED / f"{name}.npz"):
        if candidate.is_file():
            return candidate
    shipped = suggest(str(name), (path.stem for path in SHIPPED.glob("*.npz")))
    raise PolicyError(f"no policy '{name}': neither a file nor a shipped policy; {shipped}")
