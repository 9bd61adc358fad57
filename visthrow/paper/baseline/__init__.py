"""The model-based baseline TO+MPC: release by projectile motion, septic spline, nonlinear MPC of a
pendulum.

Source: the paper, Sec. IV-A. ``pendulum_model`` is the model, ``spline`` and ``throw_plan`` plan,
``mpc`` tracks the plan, ``fly_plan`` flies it in the model and on the plants, ``front`` holds the
settings of the sweep, and ``thrower`` provides throws as units of work."""

NAME = "baseline"  # its name among the policies of compare
