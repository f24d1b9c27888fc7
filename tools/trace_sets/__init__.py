"""Seeded recordings of robots whose models lack something, for the tracer: own physics, own words (docs/tracing.md, How it is tested)."""
