"""Selection of causes: the search, its candidates, and the verdicts that come of it."""
