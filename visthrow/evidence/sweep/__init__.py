"""Lists of training runs and throws: worked in resumable pieces, on several GPUs or a cluster, never twice.

``lists`` says what is to be done, ``units`` cuts it into units and knows which are done, ``work`` does them, ``pool`` hands them
out, ``record`` condenses the results into what is committed.
"""
