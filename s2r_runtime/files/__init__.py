"""Files of others, read within bounds, and their text as a person may see it."""
