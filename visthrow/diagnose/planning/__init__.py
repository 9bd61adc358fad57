"""Planning of flights: which manoeuvre separates what could not be separated."""
