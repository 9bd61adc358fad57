"""What can be said of flight logs before any model is asked: each channel, units, axes, signs and
delays by physics, what is excited.
"""
