"""Inputs under which competing hypotheses can be told apart."""
