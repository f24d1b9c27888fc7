"""Recomputes a log from itself, and names the first record that differs."""
