"""Task my_thing for s2r_runtime."""
