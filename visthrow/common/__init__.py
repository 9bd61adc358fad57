"""What every room uses: errors, files, devices, statistics, provenance, one look for pictures."""
