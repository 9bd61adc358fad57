"""The model-based baseline: release by projectile motion, septic spline, nonlinear MPC on a
pendulum (TO+MPC).

The paper's Sec. IV-A. ``pendulum`` is the model, ``spline`` and ``plan`` make the plan, ``mpc``
tracks it, ``fly`` flies it in its own model and on the plants, ``front`` has the settings of the
sweep, ``thrower`` the throws as units of work."""

NAME = "baseline"  # what compare calls it beside the policies
