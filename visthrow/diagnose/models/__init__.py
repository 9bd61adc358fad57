"""Models other than the whole throw: a ball, a motor on a stand, a quadrotor with or without a
payload; and the base classes for new models.
"""
