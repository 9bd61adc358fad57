"""Evidence: reports, sweeps and the committed records they stand on.

Records of speed are in `records/bench`, of accuracy in `records`, each with its command and commit;
`visthrow bench records` prints them."""
