"""Signal temporal logic: formulas as text, and how far traces are from violating them, for many traces at once."""
