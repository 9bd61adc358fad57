"""A black-box model of the residual forces: the reference for the selected effects, and a
substitute where none explains the flights.

Forces in the body frame are a sparse Gaussian process over body velocity, body rates and thrust:
linear in a few radial functions, whose weights have a normal prior. The model is trained on the
same statistics as the search for effects."""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from visthrow.common.rotations import matrix_of_quat, rotate_back
from visthrow.diagnose.likelihood import grammar
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.models import law_terms as laws
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Indices, Window
from visthrow.diagnose.select.point import Point, statistics_of
from visthrow.diagnose.select.terms import strongest_forces

CENTRES = 20
WIDTH = 1.5  # width of a radial function, in standard deviations of the inputs
REACHES = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Prior standard deviations of the weights to choose from by likelihood, in multiples of the
block's strongest latent force.
"""


def _inputs(window: Window) -> ndarray:
    """Return the known ones of body velocity, body rates and thrust at the knots, shape (k, I)."""
    knots = dict(window.knots)
    count = len(knots.get("time", ()))
    if "vel_w" in knots and "quat_wb" in knots:
        knots["vel_w"] = rotate_back(knots["quat_wb"], knots["vel_w"])
    known = [knots[name] for name in ("vel_w", "rate_b", "thrust") if name in knots]
    return np.hstack([np.zeros((count, 0)), *(values.reshape(count, -1) for values in known)])


@dataclass(frozen=True)
class ForceTable:
    """A linear model of forces and torques in the body frame: ``weights' radial(inputs)``."""

    mean: ndarray  # of the inputs, shape (I,)
    deviation: ndarray  # standard deviation of the inputs, shape (I,)
    centres: ndarray  # of the radial functions, in standard deviations, shape (M, I)
    blocks: tuple[str, ...]

    def radial(self, inputs: ndarray) -> ndarray:
        """Return the basis functions: constant, linear, radial; shape (k, 1 + I + M)."""
        z = (inputs - self.mean) / self.deviation
        distance = ((z[:, None, :] - self.centres) ** 2).sum(-1)
        return np.hstack((np.ones((len(z), 1)), z, np.exp(-0.5 * distance / WIDTH**2)))

    def columns(self, window: Window) -> ndarray:
        """Return the latent-force coefficients of every weight, shape (L, weights)."""
        basis = self.radial(_inputs(window))
        values = laws.KnotValues(window.knots)
        parts = []
        for block in self.blocks:
            axes = np.broadcast_to(np.eye(3), (len(basis), 3, 3))
            if block != "vehicle torque" and "quat_wb" in window.knots:
                axes = matrix_of_quat(window.knots["quat_wb"])
            latents = grammar.through_latents(window, values, block)
            columns = axes[..., None] * basis[:, None, None]
            parts.append(latents @ columns.reshape(latents.shape[1], -1))
        return np.hstack(parts)


def table_of(point: Point, rng: np.random.Generator) -> ForceTable | None:
    """Choose the basis functions from the flown states; None if windows have no knots or the model
    has no latent force.
    """
    blocks = tuple(LATENT_BLOCKS[b] for b in sorted({b for b, _ in point.noise.latent_sd}))
    if not blocks or not all("time" in w.knots and w.latent.size for w in point.windows):
        return None
    inputs = np.vstack([_inputs(w) for w in point.windows])
    if not inputs.shape[1]:
        return None
    mean = inputs.mean(0)
    deviation = np.maximum(inputs.std(0), 1e-9)
    chosen = rng.choice(len(inputs), size=min(CENTRES, len(inputs)), replace=False)
    return ForceTable(mean, deviation, ((inputs - mean) / deviation)[chosen], blocks)


@dataclass(frozen=True)
class Trained:
    """Statistics of the table's W weights by group of windows."""

    statistics: Statistics  # of the effects, followed by the weights
    reach: ndarray  # prior standard deviation of each weight at reach 1, shape (W,)

    def weights(self, keep: ndarray) -> ndarray:
        """Return the posterior mean of the weights from some groups, at the likeliest reach.

        ``keep``: mask of the groups. Shape of the result: (W,).
        """
        chosen = self.statistics.only(keep)
        of_weights = slice(-len(self.reach), None)
        information = chosen.information.sum(0)[of_weights, of_weights]
        score = chosen.score.sum(0)[of_weights]
        nats = []
        means = []
        for reach in REACHES:
            prior = reach * self.reach
            normal = information * np.outer(prior, prior) + np.eye(len(prior))
            mean = np.linalg.solve(normal, score * prior)
            nats.append(0.5 * (score * prior @ mean - np.linalg.slogdet(normal)[1]))
            means.append(prior * mean)
        return means[np.argmax(nats)]


def train(
    point: Point, table: ForceTable, groups: Indices, theta: ndarray | None = None
) -> Trained:
    """Compute the statistics of the table's weights.

    ``point``: linearised at any sizes; ``groups``: group of each window; ``theta``: sizes of the
    effects that act besides the table, in floors, shape (K,); default 0."""
    columns = [w.latent @ table.columns(w) for w in point.windows]
    statistics = statistics_of(point, point.windows, columns, range(len(columns)))
    effects = len(point.theta)
    sizes = np.zeros(len(statistics.theta))
    sizes[:effects] = 0.0 if theta is None else theta
    strongest = strongest_forces(point)
    levels = [strongest[name] for name in table.blocks]
    reach = np.repeat(levels, columns[0].shape[1] // len(levels))
    return Trained(statistics.extrapolate(sizes).sum_by(groups), reach)


def tabulate_unexplained(point: Point, seed: int) -> dict | None:
    """Return a table of the residual forces at a point, for JSON; None if none can be trained.

    Force in body axes = weights times (1, inputs, radial functions of the inputs), with inputs in
    standard deviations."""
    table = table_of(point, np.random.default_rng(seed))
    if table is None:
        return None
    trained = train(point, table, [0] * len(point.windows), point.statistics.theta)
    weights = trained.weights(np.ones(1, dtype=bool))
    by_block = weights.reshape(len(table.blocks), 3, -1)
    return {
        "label": "unexplained",
        "inputs": "body velocity [m/s], body rates [rad/s], thrust [N], as far as known",
        "mean": table.mean,
        "deviation": table.deviation,
        "centres": table.centres,
        "width": WIDTH,
        "weights": dict(zip(table.blocks, by_block)),
    }
