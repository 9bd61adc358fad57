"""Effects of the simulation itself."""

from visthrow.diagnose.catalogue.entry import POSE, Entry, Key, entry

ENTRIES: tuple[Entry, ...] = (
    entry(
        "step_error",
        "The replay's own step shows in the residuals",
        "difference to steps of half the length, 3 theta times",
        "1",
        "integrator",
        (-0.33, 8.0),
        1.0,
        0.5,
        POSE,
        "both integrators are of second order: errors grow with the square of the step",
        [Key("step_square", factor=3.0)],
        confused=("motor_tau", "mount_x"),
        manoeuvres=("none: replay with finer steps",),
    ),
)
"""theta = -1/3 is an exact integration."""
