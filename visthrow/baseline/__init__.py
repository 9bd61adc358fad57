"""The model-based baseline: release by projectile motion, septic spline, nonlinear MPC on a pendulum (TO+MPC).

The paper's Sec. IV-A. ``pendulum`` is the model, ``release``, ``spline`` and ``plan`` make the plan, ``mpc`` tracks it,
``fly`` flies it in its own model and on the plants, ``front`` sweeps, ``report`` writes, ``command`` is the subcommand.
"""

NAME = "baseline"
"""What compare calls it beside the policies."""
