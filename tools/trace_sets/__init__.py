"""Seeded recordings of robots whose models lack something, for the tracer: own physics, own words (docs/trace-figures.md)."""
