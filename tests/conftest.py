"""One thread a product for all tests: see :mod:`visthrow.diagnose.threads`."""

from visthrow.diagnose.threads import single

single()
