"""Scenario laws and safety metrics."""
