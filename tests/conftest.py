"""One thread a product for all tests, before any of them imports numpy: see :mod:`visthrow.diagnose.threads`."""

from visthrow.diagnose.threads import single

single()
