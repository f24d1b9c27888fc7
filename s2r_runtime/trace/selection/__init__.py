"""Which hypotheses the data call for: screening, stepwise search, evidence, relevance, ties."""
