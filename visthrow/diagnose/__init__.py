"""From measured flights to what the simulation gets wrong: the named cause, the extended model, the
measured gain.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """Import :func:`diagnose` when it is asked for: it needs the algebra's libraries."""
    if name == "diagnose":
        from visthrow.diagnose.select.diagnose_flights import diagnose

        return diagnose
    raise AttributeError(f"module 'visthrow.diagnose' has no attribute '{name}'")
