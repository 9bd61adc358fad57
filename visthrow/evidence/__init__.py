"""Evidence: reports, sweeps, benchmarks and the committed records they stand on."""
