"""Programs that measure throws through Betaflight in software, and their records."""
