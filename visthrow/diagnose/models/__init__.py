"""Small models beside the whole throw: a ball, a motor stand, a quadrotor alone, one with a
payload; and what a model of your own is made of.
"""
