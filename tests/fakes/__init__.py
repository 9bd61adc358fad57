"""Fakes of autopilots that no page uses, for the tests of their back-ends.

``visthrow hil fake --kind tests.fakes.fake_px4:FakePx4`` flies one from the root of a checkout.
"""

KINDS = {
    "ardupilot": "ardupilot",
    "px4": "tests.fakes.fake_px4:FakePx4",
    "betaflight": "tests.fakes.fake_betaflight:FakeBetaflight",
    "crazyflie": "tests.fakes.fake_crazyflie:FakeCrazyflie",
}
"""Back-end -> its fake, as ``--kind`` takes it."""
