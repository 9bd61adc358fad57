"""Back-ends: where commands go. ``dry-run`` (the default) sends nothing, ``ardupilot`` speaks MAVLink."""

from hil.backends.ardupilot import ArduPilot, ArduPilotParams
from hil.backends.base import Backend, DryRun, Status

__all__ = ["ArduPilot", "ArduPilotParams", "Backend", "DryRun", "Status"]
