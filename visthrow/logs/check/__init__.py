"""Units, axes, signs and delays of a flight log by physics: what must follow from what, whatever the vehicle."""
