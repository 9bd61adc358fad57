"""Evidence: reports, sweeps, benchmarks and the committed records they stand on.

Records of speed are in `bench/records`, of accuracy in `records`, each with its command and commit; `visthrow bench records` prints them.
"""
