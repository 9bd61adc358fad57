"""One thread a product for all tests: see :mod:`visthrow.diagnose.likelihood.threads`."""

from visthrow.diagnose.likelihood.threads import single

single()
