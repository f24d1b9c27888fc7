"""Zenoh transport."""
