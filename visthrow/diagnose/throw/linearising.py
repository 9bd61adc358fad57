"""Derivatives of windows' samples by effects, initial states and latent forces: which lanes are
flown, and what comes of them.

A derivative is a difference of two lanes of the same steps. Steps of twice the length, with a
nominal lane of their own, tell most of them as well; residuals always come from the nominal steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sim.effects.effect import SettingEffect
from sim.effects.setting import Setting
from sim.kernels.replay.kernel import NO_PAYLOAD
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.throw.initial_states import Direction, concerns
from visthrow.diagnose.throw.recorded_flight import NEVER
from visthrow.diagnose.throw.replay import FINENESS, KNOT_SPACING, Lane, ReplayedFlights

LATENT_SIZES = (1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5, 2e-4, 2e-4, 2e-4)
"""Of the latent forces' derivatives: force [N], torque [N m], force on the payload [N].

Small, for a steady torque is controlled away and leaves nothing in a window: with a hundred times
as much its second order was left, alike for all axes.
"""
EXACT = ("plant.vehicle.controller.gyro_time_constant", "plant.rope.payload_inertia", "step_square")
"""Numbers by which derivatives take the nominal steps: with twice as long ones they differ by more
than a fifth. In throws, where a rope whips, those by all effects and states do; latent forces there
differ by 2 %.
"""

CALM_SPEED = 0.1
"""Root mean square speed of a window [m/s] up to which the vehicle's motion against the air is the
air's own doing: rooms have draughts of that speed, and a gust brings a hovering vehicle a velocity
that goes with it, as if drag were negative.
"""
AERODYNAMIC = "aerodynamics"  # block whose effects go with that velocity


def exact(e: SettingEffect) -> bool:
    """Whether an effect's derivative needs the nominal steps in every window."""
    return any(key.path in EXACT for key in e.changes)


def without_calm_speeds(window: Window, blocks: Sequence[str], wind_w: Sequence[float]) -> Window:
    """A window in which vehicle and air hardly move against each other, without what speeds would
    tell there; others as they are.

    ``window``: with all columns; ``wind_w``: of the setting [m/s].
    """
    knots = window.knots
    if (
        "vel_w" not in knots
        or np.sqrt(np.mean(np.sum((knots["vel_w"] - wind_w) ** 2, axis=1))) > CALM_SPEED
    ):
        return window
    calm = {"vel_w": np.zeros_like(knots["vel_w"])}
    if (
        "payload_vel_w" in knots
        and np.sqrt(np.mean(np.sum(knots["payload_vel_w"] ** 2, axis=1))) < CALM_SPEED
    ):
        calm["payload_vel_w"] = np.zeros_like(knots["payload_vel_w"])
    unaffected = np.array([block != AERODYNAMIC for block in blocks])
    return replace(window, effects=window.effects * unaffected, knots={**knots, **calm})


@dataclass(frozen=True)
class Plan:
    """The lanes of one window in a run: nominal, those that ride along, those of nominal steps;
    rough nominal, the others.
    """

    window: int
    first: int  # lane
    kept: int  # first row of the knots
    fine: int  # lanes of nominal steps
    order: np.ndarray  # lanes of effects, states and latent forces, from ``first``
    nuisances: tuple[int, ...]  # directions of the initial state
    latents: tuple[tuple[int, int], ...]  # axis and knot

    def slopes(
        self, rows: int, steps: np.ndarray, directions: Sequence[Direction], measured: torch.Tensor
    ) -> list[torch.Tensor]:
        """Derivatives of the window's samples by effects, states and latent forces, shape (3 rows,
        columns) each.

        ``measured``: what all lanes of the run saw, shape (rows or more, lanes, 3).
        """
        sizes = [
            *steps,
            *[directions[d].step for d in self.nuisances],
            *[LATENT_SIZES[axis] for axis, _ in self.latents],
        ]
        columns = (
            measured[:rows, self.first : self.first + len(self.order) + 2]
            .transpose(1, 2)
            .reshape(3 * rows, -1)
        )
        for part in (columns[:, : self.fine], columns[:, self.fine :]):
            part -= part[:, :1].clone()
        K = len(steps)
        D = len(self.nuisances)
        order = torch.from_numpy(self.order).to(columns.device)
        sizes = columns.new_tensor(sizes)
        return [
            columns[:, order[part]].div_(sizes[part])
            for part in (slice(K), slice(K, K + D), slice(K + D, None))
        ]

    def window_of(
        self,
        flights: ReplayedFlights,
        setting: Setting,
        directions: Sequence[Direction],
        channel: np.ndarray,
        residual: np.ndarray,
        slopes: Sequence[np.ndarray],
        knots: Mapping[str, np.ndarray],
        moved: np.ndarray,
    ) -> Window:
        """Return the window that the lanes make up.

        ``channel``: of the window's samples; ``slopes``: see :meth:`slopes`; ``knots``: simulated
        quantities at all its knots; ``moved``: how far each window's state was moved from where its
        prior has its middle, shape (W, directions): there the residual is taken."""
        w = self.window
        f = flights
        c = f.cuts[w]
        effects, states, latents = slopes
        values = {name: value[self.kept : self.kept + f.knots[w]] for name, value in knots.items()}
        return Window(
            c.flight,
            c.phase,
            f.time[w],
            channel,
            residual + states @ moved[w, list(self.nuisances)],
            f.sigma[w],
            effects,
            states,
            np.array([directions[d].spread(c) for d in self.nuisances]),
            latents,
            np.array([axis // 3 for axis, _ in self.latents]),
            np.array([axis % 3 for axis, _ in self.latents]),
            np.array([c.start + KNOT_SPACING * knot for _, knot in self.latents]),
            at_knots(f, setting, w, values),
            c.after_slack,
        )


def lanes_of(
    flights: ReplayedFlights,
    w: int,
    alike: np.ndarray,
    needs: np.ndarray,
    directions: Sequence[Direction],
    first: int,
    kept: int,
) -> tuple[Plan, list[Lane]]:
    """Lanes of one window.

    Args:
        alike: of each effect, whether it is flown like the nominal lane.
        needs: of each effect, whether it needs the nominal steps.
        directions: of initial states; row ``(1 + d) W + w`` of the states is moved along one.
        first: number of the first lane.
        kept: first row of the knots; twice as many as the window's are taken.
    """
    c = flights.cuts[w]
    count = len(flights.cuts)
    knots = int(flights.knots[w])
    whips = c.phase in FINENESS or c.after_slack
    nuisances = tuple(d for d, x in enumerate(directions) if concerns(x, c))
    latents = tuple(
        (axis, knot) for axis in range(6 if c.payload == NO_PAYLOAD else 9) for knot in range(knots)
    )
    fine = alike | needs | whips
    effects = len(fine)
    states = len(nuisances)
    split = (
        1 + np.count_nonzero(fine) + states * whips
    )  # where the rough nominal lane stands, which latent lanes leave
    columns = [
        (int(k), Lane(w, 1 + int(k), w, rough=not fine[k]))
        for k in np.argsort(~alike, kind="stable")
    ]
    columns += [
        (effects + i, Lane(w, 0, (1 + d) * count + w, rough=not whips))
        for i, d in enumerate(nuisances)
    ]
    columns += [
        (
            effects + states + i,
            Lane(
                w,
                0,
                w,
                axis,
                knot,
                LATENT_SIZES[axis],
                resume=kept + knots + max(knot - 1, 0),
                parent=first + split,
                rough=True,
            ),
        )
        for i, (axis, knot) in enumerate(latents)
    ]
    nominal = [
        Lane(w, 0, w, keep=kept, shared=int(alike.sum())),
        Lane(w, 0, w, keep=kept + knots, rough=True),
    ]
    parts = [[(-1, lane), *(x for x in columns if x[1].rough == lane.rough)] for lane in nominal]
    numbers, lanes = zip(*parts[0], *parts[1])
    order = np.argsort(numbers, kind="stable")[2:]  # behind the nominal ones
    return Plan(w, first, kept, len(parts[0]), order, nuisances, latents), list(lanes)


def at_knots(
    flights: ReplayedFlights, setting: Setting, w: int, knots: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Simulated quantities at the knots, those of the payload where there is one."""
    c = flights.cuts[w]
    time = c.start + KNOT_SPACING * np.arange(len(knots["thrust"]))
    values = {"time": np.minimum(time, c.end)} | {
        name: value.copy() for name, value in knots.items()
    }
    if c.payload == NO_PAYLOAD:
        return {
            name: value
            for name, value in values.items()
            if not name.startswith("payload") and name != "tension"
        }
    arm = np.array(setting.plant.rope.mount) - np.array(setting.plant.vehicle.body.com)
    reach = (
        values["payload_pos_w"] - values["pos_w"] - Rotation.from_quat(values["quat_wb"]).apply(arm)
    )
    values["cable_dir_w"] = reach / np.linalg.norm(reach, axis=1, keepdims=True)
    values["mount_b"] = np.tile(arm, (len(time), 1))
    f = flights.flights[c.flight]
    if f.latch != NEVER:
        values["tension"][values["time"] > f.latch + setting.plant.release.lag] = 0.0
    return values
