"""Small models beside the whole throw: a ball, a motor stand, a quadrotor alone, one with a
payload; and the parts that a new model is made of.
"""
