"""Nominal models. Nothing is imported here: the gate's process must stay light."""
