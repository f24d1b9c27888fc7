"""Recordings of any origin, read in bounded memory, as tables, streams and transitions."""
