"""Embedded runtime assurance for robots."""
