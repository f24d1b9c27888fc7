"""The daemon and its helpers in other processes. Nothing is imported here: each process loads what it needs."""
