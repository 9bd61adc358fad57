"""Small models beside the whole throw: a ball, a pendulum, a motor stand, a camera, a quadrotor
alone, one with a payload.
"""
