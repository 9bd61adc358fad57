"""Lists of training runs and throws: worked in resumable pieces, on several GPUs or a cluster, never twice.

:mod:`visthrow.sweep.lists` says what is to be done, :mod:`~visthrow.sweep.units` cuts it into units and knows which are done,
:mod:`~visthrow.sweep.work` does them, :mod:`~visthrow.sweep.pool` hands them out, :mod:`~visthrow.sweep.record` condenses the
results into what is committed.
"""
