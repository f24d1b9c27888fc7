"""Design of inputs that separate competing hypotheses."""
